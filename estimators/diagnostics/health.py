"""When an estimate may be trusted, and its NIS over a window against the chi-square bounds."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types

from ..log import RESET
from ..numerics.jit import F1, f64, i64, inlined, jit
from ..numerics.quantiles import chi_square_quantile
from ..numerics.simd import total as sum_of
from ..track import DIVERGED, FAILED, GATED, TRACKING, USED, borrowed_columns
from .normal_nis import LEAST, MEAN, NORMALS, PROBABILITY, VARIANCE, free_degrees

FEW = 10
"""Events in a window below which it says nothing of health."""


FAR = 20
"""Rows for each reading of the window, beyond which a reading is too old to count."""


class HealthPolicy(NamedTuple):
    """When a twin may be trusted.

    `window` readings are averaged. Without a reading for `degraded_after` seconds the twin is degraded, after
    `stale_after` stale. It is diverged when the windowed NIS is `diverged_nis` times what was normal of its readings
    when the tuning was accepted (without a baseline, and at least, what it should be), when the gate
    refuses more than `diverged_gated` of the window (or they fail), or when a number is not finite. A reset begins a
    new window. It is suspect, or degraded where a sensor is lost, when a test of evidence/ is in alarm: by chance
    once in `false_alarm_every` seconds. A sensor is silent after `silent_periods` of its mean periods, and twice its
    longest silence so far; of so many more, as long as its period is known from few readings.
    """

    window: int = 50
    degraded_after: float = 5.0
    stale_after: float = 30.0
    diverged_nis: float = 10.0
    diverged_gated: float = 0.5
    false_alarm_every: float = 86400.0
    silent_periods: float = 6.0


class Bounds(NamedTuple):
    """Chi-square quantiles by degrees of freedom: the 95 % bounds."""

    low: Any
    high: Any


bounds_type = types.NamedUniTuple(F1, len(Bounds._fields), Bounds)
policy_type = types.NamedTuple((i64, f64, f64, f64, f64, f64, f64), HealthPolicy)


def chi_square_bounds(most: int) -> Bounds:
    """Quantiles for 0 to `most` degrees of freedom."""
    dof = np.arange(most + 1)
    dof[0] = 1  # of no use, but chi-square has no quantile for 0
    tail = (1.0 - PROBABILITY) / 2.0
    return Bounds(chi_square_quantile(tail, dof), chi_square_quantile(1.0 - tail, dof))


@inlined
def judges(verdict):
    """Whether a reading of this verdict says something of the estimate."""
    return verdict == USED or verdict == GATED or verdict == FAILED


@inlined
def _keep(k, row, track, channel, normal, rows, dofs, terms):
    """Write a reading into place k of the window."""
    used = track.verdict[row] == USED
    rows[k] = row
    dofs[k] = track.dof[row] if used else -1
    terms[0, k] = track.nis[row] if used else 0.0
    for j in range(NORMALS):
        terms[1 + j, k] = track.dof[row] * normal[NORMALS * channel[row] + j] if used else 0.0


@inlined
def _quantile(table, dof):
    """A quantile of chi-square with `dof` degrees of freedom, 1 at least, from those of whole numbers."""
    whole = int(dof)
    share = dof - whole
    return table[whole] if share == 0.0 else (1.0 - share) * table[whole] + share * table[whole + 1]


@inlined
def _judge(i, total, due, mean, variance, dof, used, refused, track, policy, bounds):
    """Mean NIS of the window that ends at row i, its bounds, and what it alone says of the estimate."""
    if used > 0:
        free = free_degrees(mean, variance, dof)
        track.nis_mean[i] = total / used
        track.nis_low[i] = mean / free * _quantile(bounds.low, free) / used
        track.nis_high[i] = mean / free * _quantile(bounds.high, free) / used
    else:
        track.nis_mean[i] = np.nan
        track.nis_low[i] = np.nan
        track.nis_high[i] = np.nan
    judged = used + refused
    track.consistency[i] = TRACKING
    if judged >= FEW and (refused > policy.diverged_gated * judged or total > policy.diverged_nis * due):
        track.consistency[i] = DIVERGED


@jit
def assess(first, last, t, kind, channel, track, normal, policy, bounds):
    """Fill age, windowed NIS, its bounds and consistency of rows `first` to `last` of a track.

    A row looks only at rows before it, so the outcome does not depend on how a fold was cut into pieces. The window
    changes with a reading that is used, gated or failed; the other rows have that of the row before. A reset empties
    it: what the readings said of the estimate before, they do not say of the new one. `normal` (sensors · NORMALS,) is
    what was normal of the NIS of each sensor, see normal_nis.py.
    """
    window = policy.window
    track = borrowed_columns(track)
    # The window's readings, the oldest first, lie at `begin` to `end`: row, degrees of freedom (-1 if it was refused),
    # and `terms`, 0 if it was refused: NIS, then `NORMALS`. It moves up, and back to the start when it has reached the
    # end.
    rows = np.empty(2 * window, np.int64)
    dofs = np.empty(2 * window, np.int64)
    terms = np.empty((1 + NORMALS, 2 * window))
    begin = window
    end = window
    row = first - 1
    while row >= 0 and kind[row] != RESET and end - begin < window and first - row < FAR * window:
        if judges(track.verdict[row]):
            begin -= 1
            _keep(begin, row, track, channel, normal, rows, dofs, terms)
        row -= 1
    dof = 0
    used = 0
    for k in range(begin, end):
        if dofs[k] >= 0:
            dof += dofs[k]
            used += 1
    for i in range(first, last):
        reset = kind[i] == RESET
        judged = judges(track.verdict[i])
        if i == 0 or reset or judged:
            track.age[i] = 0.0
            if judged and end == 2 * window:
                for k in range(begin, end):
                    rows[k - begin] = rows[k]
                    dofs[k - begin] = dofs[k]
                    for j in range(1 + NORMALS):
                        terms[j, k - begin] = terms[j, k]
                end -= begin
                begin = 0
            if judged:
                _keep(end, i, track, channel, normal, rows, dofs, terms)
                if dofs[end] >= 0:
                    dof += dofs[end]
                    used += 1
                end += 1
            # Out goes what is too many, too far back, or from before a reset.
            while begin < end and (reset or end - begin > window or i - rows[begin] >= FAR * window):
                if dofs[begin] >= 0:
                    dof -= dofs[begin]
                    used -= 1
                begin += 1
            # Summed anew each time: a running sum would keep the rounding of an outlier.
            total = sum_of(end - begin, terms[0, begin:].ctypes.data)
            due = sum_of(end - begin, terms[1 + LEAST, begin:].ctypes.data)
            mean = sum_of(end - begin, terms[1 + MEAN, begin:].ctypes.data)
            variance = sum_of(end - begin, terms[1 + VARIANCE, begin:].ctypes.data)
            _judge(i, total, due, mean, variance, dof, used, end - begin - used, track, policy, bounds)
        else:
            track.age[i] = track.age[i - 1] + (t[i] - t[i - 1]) * 1e-9
            track.nis_mean[i] = track.nis_mean[i - 1]
            track.nis_low[i] = track.nis_low[i - 1]
            track.nis_high[i] = track.nis_high[i - 1]
            track.consistency[i] = track.consistency[i - 1]
