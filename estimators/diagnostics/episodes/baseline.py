"""Baseline of an accepted tuning: the null hypothesis of the detectors from then on.

Innovations of real assets are never exactly white. The baseline of a tuned filter on the data on which it was accepted
is the bias, scale and correlation of each row, and the highest value of each test and of the NIS over a window.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ...fold import Fold
from ...log import RESET
from ...model.state_space import StateSpaceModel
from ...track import FAILED, GATED, USED
from ..detector_state import gate_log_ratios, no_baseline, threshold_of
from ..detector_tests import highest
from ..detectors import ALARM_NAMES, BITS, SHIFTED
from ..health import JUDGED_MEAN, MAX_ROWS_PER_READING, MIN_WINDOW_EVENTS, HealthPolicy, normal_nis
from . import judged_rows, standardised

BASELINE_MARGIN = 1.5
"""Factor on the highest value of a test, which is added to its threshold, and on the highest NIS over a window."""

MIN_MEASUREMENTS = 50  # Measurements of a row from which it has a baseline
MAX_SCALE = 1.5  # Scale of innovations beyond which R is not that of the sensor
MAX_SHIFT = 0.5  # Change of the bias from one half of a log to the other, in standard deviations, that is relevant
SHIFTS = BITS & SHIFTED != 0  # Tests of the mean


class Normal(NamedTuple):
    """Baseline of one sensor row.

    bias, scale: of its standardised innovations e; correlation: lag 1, of (e - bias) / scale; reached: highest W of the
    tests of each alarm, by name; nis: highest NIS over the twin's window at a measurement of this sensor, as a multiple
    of its mean, 0 where that is far below divergence. forced: why the data contradicted it all the same, or "".
    """

    bias: float
    scale: float
    correlation: float
    reached: Mapping[str, float]
    nis: float = 0.0
    forced: str = ""


def commission(fold: Fold) -> dict[str, Normal]:
    """Return the baseline of a fold whose tuning is accepted, by sensor row.

    Args:
        fold: Over data without faults.

    Returns:
        The baseline of each row that has `MIN_MEASUREMENTS` measurements.
    """
    model = fold.model
    found: dict[str, Normal] = {}
    for series in _series(fold):
        moments = series.moments(slice(None))
        W = series.highest(slice(None), moments)
        reached = {}
        for bit, name in enumerate(ALARM_NAMES):
            own = W[BITS == 1 << bit]
            if own.size and own.max() > 1.0:
                reached[name] = round(float(own.max()), 1)
        bias, scale, phi = (round(value, 3) for value in moments)
        found[series.row] = Normal(bias, scale, phi, reached)
    most = _most_nis(fold, normal_nis(model, baseline_of(model, found))[:, JUDGED_MEAN])
    most[BASELINE_MARGIN * most <= HealthPolicy().diverged_nis] = 0.0
    of_row = np.repeat(most, [len(sensor.rows) for sensor in model.sensors]).tolist()
    nis = {name: round(value, 3) for name, value in zip(model.row_names, of_row, strict=True)}
    return {name: normal._replace(nis=nis[name]) for name, normal in found.items()}


class RowSeries(NamedTuple):
    """Measurements of a sensor row with a baseline: n of them, in the columns that the tests of a row need.

    place: of the row. h: threshold of its tests. e: standardised innovations, NaN where not judged; refused: as in
    `highest`; values, innovation, std; r: variance of its noise; chances: `gate_log_ratios`.
    """

    model: StateSpaceModel
    place: int
    h: float
    e: np.ndarray
    refused: np.ndarray
    values: np.ndarray
    innovation: np.ndarray
    std: np.ndarray
    r: float
    chances: np.ndarray

    @property
    def row(self) -> str:
        """Name of the row."""
        return self.model.row_names[self.place]

    def moments(self, part: slice) -> tuple[float, float, float]:
        """Return bias, scale and lag-1 correlation of a part."""
        e = self.e[part]
        clipped = np.clip(e[np.isfinite(e)], -6.0, 6.0)
        bias, scale = float(clipped.mean()), float(max(clipped.std(), 1e-3))
        rest = (clipped - bias) / scale
        return bias, scale, float(np.clip(np.mean(rest[1:] * rest[:-1]), -0.95, 0.95))

    def highest(self, part: slice, moments: tuple[float, float, float]) -> np.ndarray:
        """Return the highest W of each test over a part, (TESTS,), if these moments are the baseline."""
        base = no_baseline(self.model)[self.place]
        base[:3] = moments
        base[3:] = np.inf
        columns = (self.e, self.refused, self.values, self.innovation, self.std)
        found: np.ndarray = highest(
            *(np.ascontiguousarray(column[part]) for column in columns), self.r, self.h, base, self.chances
        )
        return found


def _series(fold: Fold) -> Iterator[RowSeries]:
    """Yield the rows that have enough measurements for a baseline."""
    rows_of_fold, model, track = judged_rows(fold), fold.model, fold.track
    for s, sensor in enumerate(model.sensors):
        rows = rows_of_fold.events.of_sensor(s)
        verdict = track.verdict[rows]
        judged = np.isin(verdict, (USED, GATED, FAILED))
        refused = np.where(judged, (verdict != USED).astype(np.int8), np.int8(-1))
        for k in range(len(sensor.rows)):
            e = standardised(rows_of_fold, rows, k)
            index = model.row_start[s] + k
            if np.isfinite(e).sum() >= MIN_MEASUREMENTS:
                yield RowSeries(
                    model, index, threshold_of(model, fold.evidence, s), e, refused, rows_of_fold.events.value[rows, k],
                    track.innovation[rows, k], track.innovation_std[rows, k], float(fold.tuning.r[index]),
                    gate_log_ratios(fold.tuning.gate),
                )  # fmt: skip


def contradictions(fold: Fold) -> dict[str, str]:
    """Return why a fold cannot be a baseline, by sensor row: its noise is not that of R, or it changes within the log.

    Either half must raise no alarm of a relevant shift with the bias, scale and correlation of the other as baseline.
    """
    found: dict[str, str] = {}
    for series in _series(fold):
        scale = series.moments(slice(None))[1]
        middle = series.e.size // 2
        halves = slice(0, middle), slice(middle, None)
        if scale > MAX_SCALE:
            found[series.row] = f"its innovations are {scale:.1f} times as large as predicted"
        elif all(np.isfinite(series.e[half]).sum() >= MIN_MEASUREMENTS for half in halves):
            moments = [series.moments(half) for half in halves]
            for one, other in ((0, 1), (1, 0)):
                known, seen = (series.highest(halves[k], moments[one]) for k in (one, other))
                excess = seen - BASELINE_MARGIN * known - series.h
                relevant = abs(moments[1][0] - moments[0][0]) > MAX_SHIFT * scale
                if relevant and np.any(excess[SHIFTS] > 0.0):
                    halfway = f"{moments[0][0]:+.1f} σ before, {moments[1][0]:+.1f} σ after"
                    found[series.row] = f"its innovations shift halfway: {halfway}"
    return found


def _most_nis(fold: Fold, normal: np.ndarray) -> np.ndarray:
    """Return the highest NIS over the window at measurements of each sensor, (sensors,).

    In multiples of `normal` (sensors,) times the expected NIS; the windows are those of `health.assess`.
    """
    log, track, window = fold.log, fold.track, fold.policy.window
    rows = np.flatnonzero(np.isin(track.verdict[: fold.n], (USED, GATED, FAILED)))
    used, sensor = track.verdict[rows] == USED, log.channel[rows]
    nis = np.where(used, track.nis[rows], 0.0)
    due = np.where(used, track.dof[rows] * normal[sensor], 0.0)
    resets = np.flatnonzero(log.kind[: fold.n] == RESET)
    last_reset = np.append(-1, resets)[np.searchsorted(resets, rows)]
    begin = np.searchsorted(rows, np.maximum(rows - MAX_ROWS_PER_READING * window, last_reset), side="right")
    begin = np.maximum(begin, np.arange(1, rows.size + 1) - window)
    most = np.zeros(normal.size)
    for i, first in enumerate(begin):
        expected = due[first : i + 1].sum()
        if i + 1 - first >= MIN_WINDOW_EVENTS and expected > 0.0:
            most[sensor[i]] = max(most[sensor[i]], nis[first : i + 1].sum() / expected)
    return most


def baseline_of(model: StateSpaceModel, normals: Mapping[str, Normal]) -> np.ndarray:
    """Return the detectors' baseline, (rows, 3 + TESTS); that of white innovations for rows without one."""
    baseline = no_baseline(model)
    for name, normal in normals.items():
        own = baseline[model.row_names.index(name)]
        own[:3] = normal.bias, normal.scale, normal.correlation
        for cause, peak in normal.reached.items():
            own[3:][BITS == 1 << ALARM_NAMES.index(cause)] = BASELINE_MARGIN * peak
    return baseline


def lost_from(normals: Mapping[str, Normal]) -> float:
    """Return the multiple of its expected mean from which the NIS over a window means divergence.

    At least `BASELINE_MARGIN` times the highest multiple on the accepted data.
    """
    return max([HealthPolicy().diverged_nis, *(BASELINE_MARGIN * normal.nis for normal in normals.values())])
