"""Prediction of each sensor by the others: folds with one sensor held out at a time, and with all held out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...fold import Fold, folded
from ...log import READING, Log
from ...model.state_space import StateSpaceModel
from ...registry import find_estimator
from ...track import HELD_OUT
from ...tuning import Tuning
from ..calibration import BANDS, calibrations
from ..score import Fit, Score, score
from .responses import each

WORSE_MARGIN = 0.05
"""Share by which an error must exceed that of the open loop before the filter is said to make it worse."""


class HeldOutPrediction(NamedTuple):
    """Prediction of a sensor row without its sensor, over n measurements.

    rms, bias: of prediction minus measurement, in `unit`. coverage (3,): shares of the measurements inside the bands
    `BANDS` of the prediction; intervals (3, 2): their 95 % intervals. open_loop: RMS of the model without measurements.
    """

    row: str
    sensor: str
    unit: str
    n: int
    rms: float
    bias: float
    coverage: np.ndarray
    intervals: np.ndarray
    open_loop: float

    @property
    def worse(self) -> bool:
        """Whether the prediction is worse than that of the open loop."""
        return worse(self.rms, self.open_loop)


class Against(NamedTuple):
    """RMS error of a state with a known truth, of the filter and of the open loop, in `unit`."""

    state: str
    unit: str
    filter: float
    open_loop: float

    @property
    def worse(self) -> bool:
        """Whether the error is larger than that of the open loop."""
        return worse(self.filter, self.open_loop)


class HeldOut(NamedTuple):
    """All rows of sensors that report, and all states with a known truth."""

    rows: tuple[HeldOutPrediction, ...]
    states: tuple[Against, ...]


def worse(rms: float, floor: float) -> bool:
    """Return whether an error exceeds that of the open loop by more than the margin."""
    return bool(rms > (1.0 + WORSE_MARGIN) * floor)


def held_out(estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log) -> HeldOut:
    """Fold the log without each sensor that reports, without all, and as it is.

    Args:
        estimator: Of the twin.
        model: The model.
        tuning: As the twin's; sensors that it holds out remain so.
        log: The events; it must not grow meanwhile (give a copy).

    Raises:
        EstimatorError: As `Fold`.
        ModelError: As `Fold`.
    """
    kind, channel = log.events.kind, log.events.channel
    reporting = [int(s) for s in np.unique(channel[kind == READING])]
    none = tuning
    for name in model.sensor_names:
        none = none.set(f"use.{name}", False)
    without = [tuning.set(f"use.{model.sensor_names[s]}", False) for s in reporting]

    def run(other: Tuning) -> Fold:
        fold = folded(estimator, model, other, log)
        fold.finish()
        return fold

    executor = None if find_estimator(estimator, model).samples else "threads"
    filtered, floor, *folds = each(run, [tuning, none, *without], executor)
    open_rows = _score(floor).held_out
    rows: list[HeldOutPrediction] = []
    for s, fold in zip(reporting, folds, strict=True):
        rows += _predictions(fold, s, open_rows)
    return HeldOut(tuple(rows), tuple(_states(filtered, floor)))


def _score(fold: Fold) -> Score:
    pictures = fold.pictures.taken if fold.pictures is not None else ()
    return score(fold.track, fold.log.events, fold.model, pictures, gate=fold.tuning.gate)


def _predictions(fold: Fold, s: int, floor: dict[str, Fit]) -> list[HeldOutPrediction]:
    """Return the predictions of the rows of sensor s, which this fold holds out."""
    model, log = fold.model, fold.log
    own = log.events.of_sensor(s)
    own = own[fold.track.verdict[own] == HELD_OUT]
    events, track = log.events.select(own), fold.track.select(own)
    fits = score(track, events, model).held_out
    found = calibrations(model, events, track, marginal=fold.marginal)
    units = [row.unit for row in model.sensors[s].rows]
    first = model.row_start[s]
    by_name = dict(zip(model.row_names[first : first + len(units)], units, strict=True))
    return [
        HeldOutPrediction(
            row=entry.subject,
            sensor=model.sensor_names[s],
            unit=by_name[entry.subject],
            n=entry.n,
            rms=fits[entry.subject].rmse,
            bias=fits[entry.subject].bias,
            coverage=np.array([share.value for share in entry.coverage]),
            intervals=np.array([(share.low, share.high) for share in entry.coverage]).reshape(len(BANDS), 2),
            open_loop=floor[entry.subject].rmse if entry.subject in floor else np.nan,
        )
        for entry in found
        if entry.subject in fits
    ]


def _states(filtered: Fold, floor: Fold) -> Sequence[Against]:
    model = filtered.model
    one, other = _score(filtered), _score(floor)
    units = {state.name: state.unit for state in model.shown_states}
    found = [
        Against(name, units[name], fit.rmse, other.states[name].rmse)
        for name, fit in one.states.items()
        if name in other.states
    ]
    if one.field is not None and other.field is not None and model.grid is not None:
        found.insert(0, Against(f"{model.grid.name}, all cells", model.grid.unit, one.field.rmse, other.field.rmse))
    return found
