"""Differences between the settings of two runs, and between a twin and the same one as it was saved anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from estimators.model.state_space import StateSpaceModel
from estimators.registry import ESTIMATORS
from estimators.tuning import GATE_KEYS, SHARED_ENTRY_ROWS, Tuning

from ..result import JsonObject

if TYPE_CHECKING:
    from .twin import Twin


def began_as(twin: Twin) -> str:
    """Return the origin of the first settings in a word."""
    return "recorded" if twin.recorded else "configured"


class SettingChange(NamedTuple):
    """One entry that differs: `estimator`, a key of the tuning, or `options.<name>` of the same estimator."""

    key: str
    before: float | bool | str | None
    after: float | bool | str | None


def turned(twin: Twin, estimator: str, tuning: Tuning) -> JsonObject:
    """Return the entries that differ from those of the twin, with the twin's values."""
    return {change.key: change.before for change in difference(twin.estimator, twin.tuning, estimator, tuning)}


def difference(estimator: str, tuning: Tuning, other_estimator: str, other: Tuning) -> tuple[SettingChange, ...]:
    """Return the differences between two settings of a twin, in the order of a panel.

    The rows of a sensor that share an entry are one change, unless only their mean is the same.
    """
    model = tuning.model

    def entries(group: str, names: Sequence[str], before: np.ndarray, after: np.ndarray) -> list[SettingChange]:
        # Most edits leave the group as it is, which is then the same array.
        rows: list[int] = [] if before is after else np.flatnonzero(before != after).tolist()
        return [SettingChange(f"{group}.{names[k]}", float(before[k]), float(after[k])) for k in rows]

    def entry(key: str) -> list[SettingChange]:
        before, after = tuning.get(key), other.get(key)
        return [] if before == after else [SettingChange(key, before, after)]

    found: list[SettingChange] = []
    if estimator != other_estimator:
        found.append(SettingChange("estimator", estimator, other_estimator))
    else:
        options, others = (ESTIMATORS[estimator].complete(dict(each.options)) for each in (tuning, other))
        found += [
            SettingChange(f"options.{name}", was, others[name]) for name, was in options.items() if others[name] != was
        ]
    found += entries("Q", [noise.name for noise in model.noises], tuning.q, other.q)
    if tuning.r is not other.r:
        for key in (item.key for item in tuning.items() if item.key.startswith("R.")):
            own = tuning.rows_of(key)
            before, after = tuning.r[own], other.r[own]
            # Different values of a few rows are told one by one.
            alike = own.size >= SHARED_ENTRY_ROWS or (np.ptp(before) == 0.0 and np.ptp(after) == 0.0)
            together = entry(key) if own.size > 1 and alike else []
            found += together or entries("R", [model.row_names[k] for k in own], before, after)
    found += entries("p", [parameter.name for parameter in model.parameters], tuning.p, other.p)
    used = np.flatnonzero(tuning.used != other.used)
    found += [SettingChange(f"use.{model.sensor_names[k]}", bool(tuning.used[k]), bool(other.used[k])) for k in used]
    return (*found, *(change for key in GATE_KEYS for change in entry(key)))


def units_of(estimator: str, tuning: Tuning) -> dict[str, str]:
    """Return the unit of each entry of a tuning and each option of its estimator, for `in_words`."""
    units = {item.key: item.unit for item in tuning.items()}
    units |= {f"options.{option.name}": option.unit for option in ESTIMATORS[estimator].options}
    return {key: unit for key, unit in units.items() if unit not in ("", "1")}


def value_text(value: float | bool | str | None, none: str = "off") -> str:
    """Return the value of an entry as text, `none` for None."""
    return none if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def in_words(changes: Sequence[SettingChange], most: int = 3, units: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return the first changes in one line: Q.winding 0.01 → 0.1 °C²/s, ekf → ukf, yoke held out."""

    def words(change: SettingChange) -> str:
        key, none = change.key, "never" if change.key == "gate.reopen" else "off"
        if key.startswith("use."):
            return f"{key[4:]} {'used' if change.after else 'held out'}"
        before, after = (value_text(value, none) for value in (change.before, change.after))
        name = "" if key == "estimator" else f"{key.removeprefix('options.')} "
        return f"{name}{before} → {after} {units.get(key, '')}".rstrip()

    more = f" and {len(changes) - most} more" if len(changes) > most else ""
    return ", ".join(map(words, changes[:most])) + more


RESTART_SECTIONS = ("name", "source", "faults", "time", "maintenance", "history", "view")
"""Sections of the YAML that only a restart applies."""


def obstacle(before: Twin, after: Twin, *, from_prior: bool = False) -> str | None:
    """Return why a running twin cannot go on with the one that was saved, but must be restarted; None if it can.

    Folds that begin at the prior (`from_prior`), and not at an estimate, may consider other parameters.
    """
    old, new = (shape(twin.model, considered=not from_prior) for twin in (before, after))
    changed = [f"its {what} changed" for what in old if old[what] != new[what]]
    sections = [name for name in RESTART_SECTIONS if getattr(before.config, name) != getattr(after.config, name)]
    return next(iter([*changed, *(f"its `{name}` changed" for name in sections)]), None)


def shape(model: StateSpaceModel, *, considered: bool = True) -> Mapping[str, object]:
    """Return everything that logs, tracks, tunings and charts of a model are laid out by; `considered` states too."""
    field = model.grid
    states = model.states if considered else model.states[: model.nx - model.considered]
    return {
        "states": field.shape if field is not None else [(item.name, item.unit) for item in states],
        "sensors": [(item.name, [(row.name, row.unit) for row in item.rows]) for item in model.sensors],
        "inputs": [(item.name, item.unit) for item in model.inputs],
        "noises": [(item.name, item.unit) for item in model.noises],
        "parameters": [(item.name, item.unit) for item in model.parameters],
        "cells": model.shown.tolist(),
        "mode": model.mode,
    }


def merged(before: Twin, after: Twin, estimator: str, tuning: Tuning) -> tuple[str, Tuning]:
    """Return estimator and tuning after a reload: entries that the files changed, all others as set on the page."""
    old, new = before.tuning, after.tuning

    def taken(name: str) -> np.ndarray:
        was, is_, now = (np.asarray(getattr(each, name)) for each in (old, new, tuning))
        return np.where(is_ != was, is_, now)

    if after.estimator != before.estimator:
        chosen, options = after.estimator, dict(new.options)
    else:
        chosen, options = estimator, dict(tuning.options)
        given, was = after.options_of(chosen), before.options_of(chosen)
        changed = {name for name in given.keys() | was.keys() if given.get(name) != was.get(name)}
        options = {name: value for name, value in options.items() if name not in changed}
        options |= {name: value for name, value in given.items() if name in changed}
    fields: dict[str, Any] = {name: taken(name) for name in ("q", "r", "p", "used")}
    for name in ("gate", "gate_kind", "reopen"):
        fields[name] = getattr(new if getattr(new, name) != getattr(old, name) else tuning, name)
    found = replace(new, **fields, seed=tuning.seed).with_options(options)
    same = not difference(after.estimator, new, chosen, found)
    return chosen, replace(found, name=new.name) if same else found
