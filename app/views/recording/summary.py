"""What a session was worth when its recording was closed, in a few numbers, so that a list need not fold it again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.score import Score, score
from estimators.errors import NisusError
from estimators.log import Events
from estimators.model.state_space import StateSpaceModel
from estimators.track import Track
from estimators.tuning import Tuning

from ...live.history_copy import copy_rows
from ...live.interface import Running


def summary_of(engine: Running) -> dict[str, Any]:
    """Estimator, mean NIS and how it is judged, and the first error that could be taken, of what runs; or less.

    `error` is {name, rmse, unit, coverage, against}: of the first state with a truth, else of a sensor held out.
    """
    try:
        pull = copy_rows(engine)
        tuning, estimator = engine.folded_with()
        if pull is None:
            return {"estimator": estimator}
        return summary(estimator, tuning, pull.events, pull.track, pull.pictures)
    except NisusError:
        return {}


def summary(
    estimator: str, tuning: Tuning, events: Events, track: Track, pictures: Sequence[Picture] = ()
) -> dict[str, Any]:
    """The same of a track, with what it was folded, and of what."""
    found = score(track, events, tuning.model, pictures, gate=tuning.gate, baseline=tuning.baseline)
    return {
        "estimator": estimator,
        "nis": _plain(found.nis),
        "nis_low": _plain(found.nis_low),
        "nis_high": _plain(found.nis_high),
        "nis_words": found.nis_verdict.words,
        "error": _error(found, tuning.model),
    }


def _error(found: Score, model: StateSpaceModel) -> dict[str, Any] | None:
    units = {state.name: state.unit for state in model.shown_states}
    rows = [row.unit for sensor in model.sensors for row in sensor.rows]
    units |= dict(zip(model.row_names, rows, strict=True))
    fits = [("truth", found.states), ("held out", found.held_out)]
    for against, part in fits:
        for name, fit in part.items():
            if math.isfinite(fit.rmse):
                coverage = _plain(fit.coverage)
                unit = units.get(name, "")
                return {"name": name, "rmse": fit.rmse, "unit": unit, "coverage": coverage, "against": against}
    return None


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
