"""Health limits of a twin, the expected mean NIS, and the NIS of a window against its chi-square bounds.

For a consistent filter, innovations are white and normal, and the sum of NIS is chi-square. A commissioned twin
(`baseline.py`) has a baseline instead: the innovations of each row have a bias b, a scale s and a lag-1 correlation
φ. Then E e² = b² + s², and a long sum of n of them has the variance

    n (2 s⁴ (1 + φ²) / (1 - φ²) + 4 b² s² (1 + φ) / (1 - φ)),

which for b = 0, s = 1, φ = 0 is the 2 n of chi-square. The bounds are those of a scaled chi-square of that mean and
variance, with at most the actual degrees of freedom.

Sources: Bar-Shalom, Li & Kirubarajan (2001), 5.4.2, for the bounds; Bayley & Hammersley (1946), doi:10.2307/2983560,
for correlated sums; Satterthwaite (1946), doi:10.2307/3002019, for the scaled chi-square.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from ..log import RESET
from ..model.state_space import StateSpaceModel
from ..numerics.jit import F1, borrowed, embedded, f64, i64, inlined, linkable, plain
from ..numerics.quantiles import chi_square_quantile
from ..numerics.simd import total as sum_of
from ..track import DIVERGED, FAILED, GATED, TRACKING, USED, borrowed_columns

MIN_WINDOW_EVENTS = 10  # Events in a window below which it is not judged
CLEARING = 0.5  # Share of the limits of divergence below which it is over
MAX_EXACT = 2.0**30  # Whole numbers of which any sum over a window is exact
MAX_ROWS_PER_READING = 20  # Rows for each measurement of the window, beyond which a measurement is too old to count


class HealthPolicy(NamedTuple):
    """Limits of a twin's health.

    Attributes:
        window: Measurements that are averaged; a reset begins a new window. With 0 a fold judges no rows: it runs no
            detectors, and health and alarms stay undefined.
        degraded_after: Seconds without a measurement after which the twin is degraded.
        stale_after: Seconds without a measurement after which it is stale.
        diverged_nis: Multiple of the expected NIS (of the baseline, where that is larger) from which it has diverged.
        diverged_gated: Share of the window from which rejected or failed measurements mean the same.
        false_alarm_every: Mean seconds between false alarms of all detectors, which make it suspect or degraded.
        silent_periods: Mean periods after which a sensor has dropped out, and at least twice its longest gap; more
            while its period is known from few measurements.
        corrections: Whether states are judged by their corrections (`memory.py`), 1 or 0; those of a fleet are not.
    """

    window: int = 50
    degraded_after: float = 5.0
    stale_after: float = 30.0
    diverged_nis: float = 10.0
    diverged_gated: float = 0.5
    false_alarm_every: float = 86400.0
    silent_periods: float = 6.0
    corrections: int = 1


class Bounds(NamedTuple):
    """Chi-square quantiles by degrees of freedom, the 95 % bounds."""

    low: np.ndarray
    high: np.ndarray


bounds_type = types.NamedUniTuple(F1, len(Bounds._fields), Bounds)
policy_type = types.NamedTuple((i64, f64, f64, f64, f64, f64, f64, i64), HealthPolicy)


def chi_square_bounds(max_dof: int) -> Bounds:
    """Return the quantiles for 0 to `max_dof` degrees of freedom."""
    dof = np.arange(max_dof + 1)
    dof[0] = 1  # Unused, but chi-square has no quantile for 0.
    tail = (1.0 - PROBABILITY) / 2.0
    return Bounds(chi_square_quantile(tail, dof), chi_square_quantile(1.0 - tail, dof))


@inlined
def judges(verdict):
    """Return whether a measurement of this verdict counts in the window."""
    return verdict == USED or verdict == GATED or verdict == FAILED


@inlined
def _keep(k, row, track, channel, normal, rows, dofs, terms):
    """Write a measurement into place k of the window."""
    used = track.verdict[row] == USED
    rows[k] = row
    dofs[k] = track.dof[row] if used else -1
    terms[0, k] = track.nis[row] if used else 0.0
    for j in range(NORMALS):
        terms[1 + j, k] = track.dof[row] * normal[NORMALS * channel[row] + j] if used else 0.0


@inlined
def _quantile(table, dof):
    """Interpolate a quantile of chi-square for `dof` degrees of freedom, at least 1, between those of integers."""
    whole = int(dof)
    share = dof - whole
    return table[whole] if share == 0.0 else (1.0 - share) * table[whole] + share * table[whole + 1]


@inlined
def window_bounds(mean, variance, dof, used, low, high):
    """Return the 95 % bounds of the mean NIS of `used` measurements, of tables of quantiles by degrees of freedom."""
    free = free_degrees(mean, variance, dof)
    return mean / free * _quantile(low, free) / used, mean / free * _quantile(high, free) / used


@inlined
def _all_whole(normal):
    """Return whether the expected NIS are whole numbers, as without a baseline: sums of them have no rounding."""
    for k in range(normal.size):
        if not (abs(normal[k]) < MAX_EXACT and normal[k] == np.floor(normal[k])):
            return False
    return True


@embedded
def write_window(i, total, due, kept, used, nis_low, nis_high, policy, track):
    """Fill windowed NIS, its bounds and consistency of row i from a window of `kept` measurements, `used` of them used.

    total, due: Sum of their NIS, and its expected value.
    """
    track.nis_mean[i] = total / used if used > 0 else np.nan
    track.nis_low[i] = nis_low
    track.nis_high[i] = nis_high
    limit = CLEARING if i > 0 and track.consistency[i - 1] == DIVERGED else 1.0
    lost = kept - used > limit * policy.diverged_gated * kept or total > limit * policy.diverged_nis * due
    track.consistency[i] = DIVERGED if kept >= MIN_WINDOW_EVENTS and lost else TRACKING


@embedded
def keep_window(i, t, track):
    """Fill age, windowed NIS, its bounds and consistency of a row i that is no judged measurement."""
    track.age[i] = track.age[i - 1] + (t[i] - t[i - 1]) * 1e-9
    track.nis_mean[i] = track.nis_mean[i - 1]
    track.nis_low[i] = track.nis_low[i - 1]
    track.nis_high[i] = track.nis_high[i - 1]
    track.consistency[i] = track.consistency[i - 1]


@linkable
def assess(first, last, t, kind, channel, track, normal, policy, bounds):
    """Fill age, windowed NIS, its bounds and consistency of rows `first` to `last` of a track.

    A row depends only on rows before it, so the result does not depend on the pieces of a fold. The window changes
    with a measurement that is used, gated or failed; other rows keep that of the row before. A reset empties it.
    `normal` (sensors · NORMALS,): expected NIS of each sensor, see `normal_nis`.
    """
    window = policy.window
    t, kind, channel, track = borrowed(t), borrowed(kind), borrowed(channel), borrowed_columns(track)
    low, high = borrowed(bounds.low), borrowed(bounds.high)
    # The window lies at `begin` to `end`, the oldest first: row, degrees of freedom (-1 if rejected), and `terms` (0 if
    # rejected): NIS, then `NORMALS`. It moves up, and back to the start when it reaches the end.
    room, places = np.empty((1 + NORMALS, 2 * window)), np.empty((2, 2 * window), np.int64)
    terms = borrowed(room)
    rows, dofs = borrowed(places[0]), borrowed(places[1])
    begin = window
    end = window
    row = first - 1
    while row >= 0 and kind[row] != RESET and end - begin < window and first - row < MAX_ROWS_PER_READING * window:
        if judges(track.verdict[row]):
            begin -= 1
            _keep(begin, row, track, channel, normal, rows, dofs, terms)
        row -= 1
    whole = _all_whole(normal)
    dof = 0
    used = 0
    due = mean = variance = 0.0
    for k in range(begin, end):
        if dofs[k] >= 0:
            dof += dofs[k]
            used += 1
        due += terms[1 + JUDGED_MEAN, k]
        mean += terms[1 + MEAN, k]
        variance += terms[1 + VARIANCE, k]
    # The bounds change only with these.
    bounded_dof, bounded_used, bounded_mean, bounded_variance = -1, -1, np.nan, np.nan
    nis_low = nis_high = np.nan
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
                due += terms[1 + JUDGED_MEAN, end]
                mean += terms[1 + MEAN, end]
                variance += terms[1 + VARIANCE, end]
                end += 1
            # Drop measurements beyond the window, too old, or from before a reset.
            while begin < end and (reset or end - begin > window or i - rows[begin] >= MAX_ROWS_PER_READING * window):
                if dofs[begin] >= 0:
                    dof -= dofs[begin]
                    used -= 1
                due -= terms[1 + JUDGED_MEAN, begin]
                mean -= terms[1 + MEAN, begin]
                variance -= terms[1 + VARIANCE, begin]
                begin += 1
            # Summed again each time: a running sum would keep the rounding of an outlier.
            total = sum_of(end - begin, terms[0, begin:])
            if not whole:
                due = sum_of(end - begin, terms[1 + JUDGED_MEAN, begin:])
                mean = sum_of(end - begin, terms[1 + MEAN, begin:])
                variance = sum_of(end - begin, terms[1 + VARIANCE, begin:])
            if used == 0:
                nis_low = nis_high = np.nan
            elif dof != bounded_dof or used != bounded_used or mean != bounded_mean or variance != bounded_variance:
                nis_low, nis_high = window_bounds(mean, variance, dof, used, low, high)
            bounded_dof, bounded_used, bounded_mean, bounded_variance = dof, used, mean, variance
            write_window(i, total, due, end - begin, used, nis_low, nis_high, policy, track)
        else:
            keep_window(i, t, track)
    # Used to the end: their views are not counted, and the memory would be given back.
    room[0, 0], places[0, 0] = 0.0, 0


PROBABILITY = 0.95  # Probability of the bounds in charts and reports

JUDGED_MEAN, MEAN, VARIANCE = range(3)
NORMALS = 3  # Expected NIS of a sensor: mean, at least 1, for divergence; mean and variance of one degree of freedom


def normal_nis(model: StateSpaceModel, baseline: np.ndarray) -> np.ndarray:
    """Return the expected NIS of each sensor, (sensors, NORMALS), averaged over its rows.

    Args:
        model: The model.
        baseline: Bias, scale and correlation of each row in its first columns, (rows, 3 or more).
    """
    b, s, phi = baseline[:, 0], baseline[:, 1], baseline[:, 2]
    mean = b**2 + s**2
    variance = 2.0 * s**4 * (1.0 + phi**2) / (1.0 - phi**2) + 4.0 * b**2 * s**2 * (1.0 + phi) / (1.0 - phi)
    rows = zip(model.row_start, (len(sensor.rows) for sensor in model.sensors), strict=True)
    means = [(mean[start : start + n].mean(), variance[start : start + n].mean()) for start, n in rows]
    return np.array([(max(m, 1.0), m, v) for m, v in means], float).reshape(-1, NORMALS)


@inlined
def free_degrees(mean: float, variance: float, dof: float) -> float:
    """Return the degrees of freedom of the scaled chi-square of that mean and variance, from 1 to `dof`."""
    return max(1.0, min(2.0 * mean * mean / variance, float(dof)))


def nis_bounds(dof: np.ndarray, readings: int, normal: np.ndarray | None = None) -> tuple[float, float]:
    """Return the 95 % bounds of the mean NIS of `readings` measurements.

    Args:
        dof: Their total degrees of freedom by sensor, (sensors,).
        readings: Their number.
        normal: Expected NIS of each sensor (`normal_nis`); None for white, normal innovations.
    """
    total = float(np.sum(dof))
    if not total:
        return np.nan, np.nan
    mean, variance = (total, 2.0 * total) if normal is None else (dof @ normal[:, MEAN], dof @ normal[:, VARIANCE])
    free = plain(free_degrees)(float(mean), float(variance), total)
    tail = (1.0 - PROBABILITY) / 2.0
    low, high = (float(mean / free * chi_square_quantile(q, free) / readings) for q in (tail, 1.0 - tail))
    return low, high
