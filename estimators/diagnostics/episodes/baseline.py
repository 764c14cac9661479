"""Baseline of an accepted tuning: the null hypothesis of the detectors from then on.

Innovations of real assets are never exactly white. The baseline of a tuned filter on the data on which it was accepted
is the bias, scale and correlation of each row, and the highest value of each test and of the NIS over a window.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ...fold import Fold
from ...log import READING, RESET
from ...model.state_space import StateSpaceModel
from ...track import FAILED, GATED, USED
from ..detector_state import gate_log_ratios, no_baseline, threshold_of
from ..detector_tests import highest
from ..detectors import ALARM_NAMES, BITS
from ..health import JUDGED_MEAN, MAX_ROWS_PER_READING, MIN_WINDOW_EVENTS, HealthPolicy, normal_nis
from . import judged_rows, standardised

BASELINE_MARGIN = 1.5
"""Factor on the highest value of a test, which is added to its threshold, and on the highest NIS over a window."""

MIN_MEASUREMENTS = 50  # Measurements of a row from which it has a baseline


class Normal(NamedTuple):
    """Baseline of one sensor row.

    bias, scale: of its standardised innovations e; correlation: lag 1, of (e - bias) / scale; reached: highest W of the
    tests of each alarm, by name; nis: highest NIS over the twin's window at a measurement of this sensor, as a multiple
    of its mean, 0 where that is far below divergence.
    """

    bias: float
    scale: float
    correlation: float
    reached: Mapping[str, float]
    nis: float = 0.0


def commission(fold: Fold) -> dict[str, Normal]:
    """Return the baseline of a fold whose tuning is accepted, by sensor row.

    Args:
        fold: Over data without faults.

    Returns:
        The baseline of each row that has `MIN_MEASUREMENTS` measurements.
    """
    model, log, track = fold.model, fold.log, fold.track
    found: dict[str, Normal] = {}
    for s, sensor in enumerate(model.sensors):
        rows = np.flatnonzero((log.kind[: fold.n] == READING) & (log.channel[: fold.n] == s))
        verdict = track.verdict[rows]
        h = threshold_of(model, fold.evidence, s)
        for k in range(len(sensor.rows)):
            e = standardised(judged_rows(fold), rows, k)
            known = np.isfinite(e)
            if known.sum() < MIN_MEASUREMENTS:
                continue
            clipped = np.clip(e[known], -6.0, 6.0)
            bias, scale = float(clipped.mean()), float(max(clipped.std(), 1e-3))
            rest = (clipped - bias) / scale
            phi = float(np.clip(np.mean(rest[1:] * rest[:-1]), -0.95, 0.95))
            index = model.row_start[s] + k
            base = no_baseline(model)[index]
            base[:3] = bias, scale, phi
            base[3:] = np.inf
            judged = np.isin(verdict, (USED, GATED, FAILED))
            refused = np.where(judged, (verdict != USED).astype(np.int8), np.int8(-1))
            values = np.ascontiguousarray(log.value[rows, k])
            nu, std = (np.ascontiguousarray(column[rows, k]) for column in (track.innovation, track.innovation_std))
            r, chances = float(fold.tuning.r[index]), gate_log_ratios(fold.tuning.gate)
            W = highest(e, refused, values, nu, std, r, h, base, chances)
            reached = {}
            for bit, name in enumerate(ALARM_NAMES):
                own = W[BITS == 1 << bit]
                if own.size and own.max() > 1.0:
                    reached[name] = round(float(own.max()), 1)
            found[model.row_names[index]] = Normal(round(bias, 3), round(scale, 3), round(phi, 3), reached)
    most = _most_nis(fold, normal_nis(model, baseline_of(model, found))[:, JUDGED_MEAN])
    most[BASELINE_MARGIN * most <= HealthPolicy().diverged_nis] = 0.0
    of_row = np.repeat(most, [len(sensor.rows) for sensor in model.sensors]).tolist()
    nis = {name: round(value, 3) for name, value in zip(model.row_names, of_row, strict=True)}
    return {name: normal._replace(nis=nis[name]) for name, normal in found.items()}


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
