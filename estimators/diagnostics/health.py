"""When an estimate may be trusted, and its NIS over a window against the chi-square bounds."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types

from ..log import RESET
from ..numerics.jit import F1, f64, i64, inlined, jit
from ..numerics.quantiles import chi_square_quantile
from ..numerics.simd import total as sum_of
from ..track import DIVERGED, FAILED, GATED, TRACKING, USED

PROBABILITY = 0.95
"""Of the bounds that charts and reports show."""


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


def nis_bounds(dof: int, readings: int) -> tuple[float, float]:
    """95 % bounds of the mean NIS of `readings` readings with `dof` degrees of freedom in all.

    Source: Bar-Shalom, Li & Kirubarajan (2001), 5.4.2.
    """
    tail = (1.0 - PROBABILITY) / 2.0
    return float(chi_square_quantile(tail, dof) / readings), float(chi_square_quantile(1.0 - tail, dof) / readings)


@inlined
def judges(verdict):
    """Whether a reading of this verdict says something of the estimate."""
    return verdict == USED or verdict == GATED or verdict == FAILED


@inlined
def _keep(k, row, track, channel, normal, rows, nis, dofs, due):
    """Write a reading into place k of the window."""
    used = track.verdict[row] == USED
    rows[k] = row
    nis[k] = track.nis[row] if used else 0.0
    dofs[k] = track.dof[row] if used else -1
    due[k] = track.dof[row] * normal[channel[row]] if used else 0.0


@inlined
def _judge(i, total, due, dof, used, refused, track, policy, bounds):
    """Mean NIS of the window that ends at row i, its bounds, and what it alone says of the estimate."""
    if used > 0:
        track.nis_mean[i] = total / used
        track.nis_low[i] = bounds.low[dof] / used
        track.nis_high[i] = bounds.high[dof] / used
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
    it: what the readings said of the estimate before, they do not say of the new one. `normal` (sensors,) is how many
    times the expected NIS was normal of each sensor, see evidence/bank.py.
    """
    window = policy.window
    # The window's readings, the oldest first, lie at `begin` to `end`: row, NIS (0 if it was refused), degrees of
    # freedom (-1 if it was refused), NIS that was normal (0 if it was refused). It moves up, and back to the
    # start when it has reached the end.
    rows = np.empty(2 * window, np.int64)
    nis = np.empty(2 * window)
    dofs = np.empty(2 * window, np.int64)
    dues = np.empty(2 * window)
    begin = window
    end = window
    row = first - 1
    while row >= 0 and kind[row] != RESET and end - begin < window and first - row < FAR * window:
        if judges(track.verdict[row]):
            begin -= 1
            _keep(begin, row, track, channel, normal, rows, nis, dofs, dues)
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
                    nis[k - begin] = nis[k]
                    dofs[k - begin] = dofs[k]
                    dues[k - begin] = dues[k]
                end -= begin
                begin = 0
            if judged:
                _keep(end, i, track, channel, normal, rows, nis, dofs, dues)
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
            total = sum_of(end - begin, nis[begin:].ctypes.data)
            due = sum_of(end - begin, dues[begin:].ctypes.data)
            _judge(i, total, due, dof, used, end - begin - used, track, policy, bounds)
        else:
            track.age[i] = track.age[i - 1] + (t[i] - t[i - 1]) * 1e-9
            track.nis_mean[i] = track.nis_mean[i - 1]
            track.nis_low[i] = track.nis_low[i - 1]
            track.nis_high[i] = track.nis_high[i - 1]
            track.consistency[i] = track.consistency[i - 1]
