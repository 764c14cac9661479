"""What differs between two settings of a twin: what has been turned since the session began, or between two runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from estimators.registry import ESTIMATORS
from estimators.tuning import GATE_KEYS

if TYPE_CHECKING:
    from estimators.tuning import Tuning

    from ..twin.twin import Twin


def began_as(twin: Twin) -> str:
    """Where the first settings come from, in a word."""
    return "recorded" if twin.recorded else "configured"


class Change(NamedTuple):
    """One entry that differs: `estimator`, a key of the tuning, or `options.<name>` where the estimator is the same."""

    key: str
    before: float | bool | str | None
    after: float | bool | str | None


def turned(twin: Twin, estimator: str, tuning: Tuning) -> dict[str, Any]:
    """What differs from the beginning, with the value that it had there."""
    return {change.key: change.before for change in difference(twin.estimator, twin.tuning, estimator, tuning)}


def difference(estimator: str, tuning: Tuning, other_estimator: str, other: Tuning) -> tuple[Change, ...]:
    """What differs between two settings of a twin, in the order of a panel.

    The many rows of a sensor that share an entry are one, unless only their mean is the same.
    """
    model = tuning.model
    found: list[Change] = []
    if estimator != other_estimator:
        found.append(Change("estimator", estimator, other_estimator))
    else:
        entry = ESTIMATORS[estimator]
        options, others = (entry.complete(dict(each.options)) for each in (tuning, other))
        found += [Change(f"options.{name}", was, others[name]) for name, was in options.items() if others[name] != was]
    found += _entries("Q", [noise.name for noise in model.noises], tuning.q, other.q)
    found += _of_readings(tuning, other)
    found += _entries("p", [parameter.name for parameter in model.parameters], tuning.p, other.p)
    used = np.flatnonzero(tuning.used != other.used)
    found += [Change(f"use.{model.sensor_names[k]}", bool(tuning.used[k]), bool(other.used[k])) for k in used]
    return (*found, *(Change(key, tuning.get(key), other.get(key)) for key in GATE_KEYS if _differ(tuning, other, key)))


def in_words(changes: Sequence[Change], most: int = 3) -> str:
    """The first of them in one line: Q.winding 0.01 → 0.1, ekf → ukf, yoke held out."""
    said = [_words(*change) for change in changes[:most]]
    return ", ".join(said) + (f" and {len(changes) - most} more" if len(changes) > most else "")


def _words(key: str, before: float | bool | str | None, after: float | bool | str | None) -> str:
    if key == "estimator":
        return f"{before} → {after}"
    if key.startswith("use."):
        return f"{key[4:]} {'used' if after else 'held out'}"
    none = "never" if key == "gate.reopen" else "off"
    first, second = (none if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
                     for value in (before, after))  # fmt: skip
    return f"{key.removeprefix('options.')} {first} → {second}"


def _entries(group: str, names: Sequence[str], before: np.ndarray, after: np.ndarray) -> list[Change]:
    # Most edits leave the group as it is, which is then the same array.
    rows: list[int] = [] if before is after else np.flatnonzero(before != after).tolist()
    return [Change(f"{group}.{names[k]}", float(before[k]), float(after[k])) for k in rows]


def _of_readings(tuning: Tuning, other: Tuning) -> list[Change]:
    if tuning.r is other.r:
        return []
    model = tuning.model
    found: list[Change] = []
    shared = {item.key for item in tuning.items()} - {f"R.{name}" for name in model.row_names}
    for sensor, start in zip(model.sensors, model.row_start, strict=True):
        own, key = slice(start, start + len(sensor.rows)), f"R.{sensor.name}"
        if key in shared and tuning.get(key) != other.get(key):
            found.append(Change(key, tuning.get(key), other.get(key)))
        else:
            found += _entries("R", model.row_names[own], tuning.r[own], other.r[own])
    return found


def _differ(tuning: Tuning, other: Tuning, key: str) -> bool:
    return tuning.get(key) != other.get(key)
