"""The settings that a session began with, as recorded or as the YAML says, and what has been turned since."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.registry import ESTIMATORS
from estimators.tuning import GATE_KEYS

if TYPE_CHECKING:
    from estimators.tuning import Tuning

    from ..twin.twin import Twin


def began_as(twin: Twin) -> str:
    """Where the first settings come from, in a word."""
    return "recorded" if twin.recorded else "configured"


def turned(twin: Twin, estimator: str, tuning: Tuning) -> dict[str, Any]:
    """What differs from the beginning, with the value that it had there.

    Keys are `estimator`, those of the tuning, and `options.<name>` while the estimator is still the same.
    """
    first: Tuning = twin.tuning
    found: dict[str, Any] = {}
    if estimator != twin.estimator:
        found["estimator"] = twin.estimator
    else:
        entry = ESTIMATORS[estimator]
        options = entry.complete(dict(tuning.options))
        was = entry.complete(dict(first.options))
        found |= {f"options.{name}": value for name, value in was.items() if options[name] != value}
    found |= {a.key: a.value for a, b in zip(first.items(), tuning.items(), strict=True) if a.value != b.value}
    # Rows that share an entry may differ and still have the same mean.
    rows = [k for k in np.flatnonzero(first.r != tuning.r) if not _listed(first, int(k), found)]
    found |= {f"R.{first.model.row_names[k]}": float(first.r[k]) for k in rows}
    names = first.model.sensor_names
    found |= {f"use.{names[k]}": bool(first.used[k]) for k in np.flatnonzero(first.used != tuning.used)}
    found |= {key: first.get(key) for key in GATE_KEYS if tuning.get(key) != first.get(key)}
    return found


def _listed(tuning: Tuning, row: int, found: dict[str, Any]) -> bool:
    model = tuning.model
    sensor = int(np.searchsorted(model.row_start, row, side="right")) - 1
    return f"R.{model.row_names[row]}" in found or f"R.{model.sensor_names[sensor]}" in found
