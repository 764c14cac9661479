"""A twin whose files were saved anew: what of it the running fold can take over, and with which tuning it goes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.model.state_space import StateSpaceModel
from estimators.tuning import Tuning

from .changes import difference

if TYPE_CHECKING:
    from ..twin.twin import Twin

ANEW = ("name", "source", "faults", "time", "maintenance", "history", "view")
"""Sections of the YAML that a running engine has already acted upon."""


@dataclass(frozen=True)
class Reloaded:
    """In the engine's inbox: go on with this twin, of the same shape; `why` says what was saved or loaded.

    If not `exact`, what was turned since stays turned, where the twin does not say something new.
    """

    twin: Twin
    why: str
    exact: bool = False


def obstacle(before: Twin, after: Twin) -> str | None:
    """Why what runs cannot go on with a twin as it was saved, and must be started anew; None if it can."""
    old, new = shape(before.model), shape(after.model)
    for what in old:
        if old[what] != new[what]:
            return f"its {what} changed"
    for section in ANEW:
        if getattr(before.config, section) != getattr(after.config, section):
            return f"its `{section}` changed"
    return None


def shape(model: StateSpaceModel) -> Mapping[str, Any]:
    """What logs, tracks, tunings and charts of a model are laid out by."""
    field = model.grid
    return {
        "states": field.shape if field is not None else [(item.name, item.unit) for item in model.states],
        "sensors": [(item.name, [(row.name, row.unit) for row in item.rows]) for item in model.sensors],
        "inputs": [(item.name, item.unit) for item in model.inputs],
        "noises": [(item.name, item.unit) for item in model.noises],
        "parameters": [(item.name, item.unit) for item in model.parameters],
        "cells": model.shown.tolist(),
        "mode": model.mode,
    }


def merged(before: Twin, after: Twin, estimator: str, tuning: Tuning) -> tuple[str, Tuning]:
    """Estimator and tuning to go on with: what the files changed as they say, the rest as it was turned on the page."""
    old, new = before.tuning, after.tuning

    def taken(name: str) -> np.ndarray:
        was, is_, now = (np.asarray(getattr(each, name)) for each in (old, new, tuning))
        return np.where(is_ != was, is_, now)

    if after.estimator != before.estimator:
        chosen, options = after.estimator, dict(new.options)
    else:
        chosen, options = estimator, dict(tuning.options)
        given, was = after.options_of(chosen), before.options_of(chosen)
        for name in given.keys() | was.keys():
            if given.get(name) != was.get(name):
                options.pop(name, None)
                options |= {name: given[name]} if name in given else {}
    found = replace(
        new,
        q=taken("q"),
        r=taken("r"),
        p=taken("p"),
        used=taken("used"),
        gate=(new if new.gate != old.gate else tuning).gate,
        gate_kind=(new if new.gate_kind != old.gate_kind else tuning).gate_kind,
        reopen=(new if new.reopen != old.reopen else tuning).reopen,
        seed=tuning.seed,
    ).with_options(options)
    same = not difference(after.estimator, new, chosen, found)
    return chosen, replace(found, name=new.name) if same else found
