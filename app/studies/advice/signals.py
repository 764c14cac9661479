"""Signals of a recording: sample rate, gaps, resolution, noise, common times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sources.inspect import RecordingContents, SignalSeries, holes

MIN_VALUES = 20  # values needed to estimate a noise

SKIPPED = re.compile(
    r"time|epoch|date|count|check|crc|valid|status|mode|error|alive|_id$|^id$|parity|accuracy", re.IGNORECASE
)
"""Names that are not measurements."""

DEGREES = ("deg", "°", "degree", "degrees")

MAX_SWITCH_LEVELS = 8  # levels up to which a signal is a switch and no measurement


class Signal(NamedTuple):
    """A signal and properties of its values.

    `rate` is readings a second by the usual interval, NaN with none; `holes` how many gaps far longer than usual, and
    `longest` the longest, s. `resolution` is the smallest step between two values, `levels` how many values there are.
    `noise` is the standard deviation of its roughness, in its unit, at least that of its resolution.
    `kind` is "signal", "switch", "counter", "constant", or "short". `wraps`: an angle in degrees that jumps by a turn;
    its series is in radians, and goes on where the angle jumps.
    """

    name: str
    message: str | None
    series: SignalSeries
    rate: float
    holes: int
    longest: float
    resolution: float
    levels: int
    noise: float
    kind: str
    wraps: bool = False


def signals(found: RecordingContents) -> list[Signal]:
    """All signals with values, in the order of the recording."""
    offers: list[tuple[str | None, SignalSeries]] = [(m.name, series) for m in found.messages for series in m.signals]
    offers += [(None, series) for series in found.columns]
    return [signal(message, series) for message, series in offers if series.values.size]


def signal(message: str | None, series: SignalSeries) -> Signal:
    """Describe one series."""
    wraps = series.unit in DEGREES and bool(np.any(np.abs(np.diff(series.values)) > 300.0))
    if wraps:
        series = replace(series, unit="rad", values=np.unwrap(np.radians(series.values)))
    t, y = series.t, series.values
    apart = np.diff(t)[np.diff(t) > 0] * 1e-9
    rate = 1.0 / float(np.median(apart)) if apart.size else np.nan
    levels = np.unique(y)
    resolution = step_of(levels)
    noise = max(rough(t, y), resolution / np.sqrt(12.0))
    return Signal(
        series.name,
        message,
        series,
        rate,
        len(holes(t)),
        float(apart.max()) if apart.size else 0.0,
        resolution,
        int(levels.size),
        noise,
        _kind(series, levels),
        wraps,
    )


def _kind(series: SignalSeries, levels: np.ndarray) -> str:
    if series.values.size < MIN_VALUES:
        return "short"
    if levels.size == 1:
        return "constant"
    if levels.size <= MAX_SWITCH_LEVELS:
        return "switch"
    if SKIPPED.search(series.name):
        return "counter"
    return "signal"


def step_of(levels: np.ndarray) -> float:
    """The smallest step between sorted values, less than which is the rounding of their decoding; 0 without any."""
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * max(float(np.ptp(levels)), 1e-300)] if levels.size > 1 else steps
    return float(steps.min()) if steps.size else 0.0


def rough(t: np.ndarray, y: np.ndarray) -> float:
    """Standard deviation of the noise of a smooth curve that is sampled at t (ns), (n,), with any intervals.

    e_k = a y_(k-1) + b y_(k+1) - y_k is a value minus the straight line between its neighbours, with
    a = (t_(k+1) - t_k) / (t_(k+1) - t_(k-1)) and b = 1 - a; σ² = mean of e_k² / (a² + b² + 1). What is not smooth over
    two intervals counts as noise, so this is an upper bound.

    Source: Gasser, Sroka & Jennen-Steinmetz (1986), doi:10.1093/biomet/73.3.625, equation 2.
    """
    keep = np.flatnonzero(np.diff(t, prepend=t[0] - 1) > 0)
    s, v = t[keep] * 1e-9, y[keep]
    if v.size < 3:
        return 0.0
    h = np.diff(s)
    usual = np.median(h)
    a = h[1:] / (h[1:] + h[:-1])
    b = 1.0 - a
    e = a * v[:-2] + b * v[2:] - v[1:-1]
    # Nothing is straight across a hole.
    near = (h[1:] < 3.0 * usual) & (h[:-1] < 3.0 * usual)
    square = e[near] ** 2 / (a[near] ** 2 + b[near] ** 2 + 1.0)
    return float(np.sqrt(np.mean(square))) if square.size else 0.0


MIN_STANDARD_ERRORS = 3.0
"""Standard errors of a variance of differences, √(8 / n) of it for white noise, below which it is not significant."""

WALK_INTERVALS = 20  # intervals over which a slow walk is looked for


def noise_of(series: SignalSeries, smooth: bool | None = None) -> tuple[bool, float, float]:
    """Whether a signal moves smoothly, its process noise in one second, and the variance of its readings.

    Of a random walk with noisy readings, y = x + v, the differences d have E d² = q dt + 2 r and E d_k d_(k+1) = -r. Of
    one whose speed is a random walk, the second differences e have E e² = ⅔ q dt³ + 6 r and
    E e_k e_(k+1) = q dt³/6 - 4 r. It moves smoothly if its differences follow one another, with a correlation above ½,
    which noise alone makes negative; `smooth` decides that in advance. A variance r is at least that of the
    resolution, step²/12.

    Source: the covariances of the differences, from the definitions; e is the integral of the noise of the speed
    with a triangle of width 2 dt and height dt.
    """
    y, t = series.values, series.t * 1e-9
    dt = float(np.median(np.diff(t)[np.diff(t) > 0])) if np.any(np.diff(t) > 0) else 1.0
    steady = np.flatnonzero(np.abs(np.diff(t) - dt) < 0.5 * dt)
    d = np.diff(y)
    floor = max(step_of(np.unique(y)) ** 2 / 12, 1e-12 * float(np.mean(d**2))) or 1e-12
    both = steady[:-1][np.diff(steady) == 1] if steady.size > 1 else steady[:0]
    power = float(np.mean(d[steady] ** 2)) if steady.size else float(np.mean(d**2))
    follow = float(np.mean(d[both] * d[both + 1])) if both.size else 0.0
    power = max(power, floor)
    if not (follow > 0.5 * power if smooth is None else smooth):
        r = max(min(-follow, 0.5 * power), floor)
        q = max(power - 2 * r, 0.01 * power) / dt
        if q * dt < MIN_STANDARD_ERRORS * power * np.sqrt(8.0 / max(1, both.size)):
            # Hardly told from none by one interval; after many the walk stands out from the noise, if there is one.
            far = y[WALK_INTERVALS:] - y[:-WALK_INTERVALS]
            whole = (t[WALK_INTERVALS:] - t[:-WALK_INTERVALS]) < 1.5 * WALK_INTERVALS * dt
            grown = float(np.mean(far[whole] ** 2)) if whole.any() else 0.0
            q = max(grown - 2 * r, 1e-4 * WALK_INTERVALS * power) / (WALK_INTERVALS * dt)
        return False, q, r
    e = d[both + 1] - d[both]
    second = max(float(np.mean(e**2)), floor)
    next_to = np.flatnonzero(np.diff(both) == 1)
    lagged = float(np.mean(e[next_to] * e[next_to + 1])) if next_to.size else 0.0
    r = max(min((second / 4 - lagged) / 5.5, second / 6), floor)
    return True, max(second - 6 * r, 0.01 * second) / (2 / 3 * dt**3), r


def walk_of(series: SignalSeries) -> float:
    """Variance that a random walk with noisy readings adds in one second, whether it moves smoothly or not.

    E d² = q dt + 2 r of its differences, r by its roughness (`rough`).
    """
    d, dt = np.diff(series.values), np.diff(series.t) * 1e-9
    later = dt > 0.0
    if not later.any():
        return 1.0
    power = float(np.mean(d[later] ** 2))
    r = min(rough(series.t, series.values) ** 2, 0.495 * power)
    return max(power - 2.0 * r, 1e-12) / float(np.mean(dt[later]))


MAX_GRID_TIMES = 4000  # times of a grid, at most
MAX_GAP_INTERVALS = 5.0  # usual intervals, beyond which nothing is known between two values


def common(series: Sequence[SignalSeries]) -> tuple[np.ndarray, np.ndarray]:
    """Means of several signals over equal intervals: times (n,) in s from the first, and values (n, signals).

    Intervals are those of the slowest signal or longer, so that there are no more than 4000. What has no value of its
    own in one is taken from the line between its neighbours; NaN in a hole, and before and after it spoke.
    """
    begin = max(int(one.t[0]) for one in series)
    end = min(int(one.t[-1]) for one in series)
    if end <= begin:
        return np.zeros(0), np.zeros((0, len(series)))
    usual = [float(np.median(np.diff(one.t)[np.diff(one.t) > 0])) if one.t.size > 1 else 1e9 for one in series]
    step = max(max(usual), (end - begin) / MAX_GRID_TIMES)
    edges = np.arange(begin, end + step, step)
    middles = 0.5 * (edges[1:] + edges[:-1])
    columns = [
        _mean(one, edges, middles, MAX_GAP_INTERVALS * max(step, each)) for one, each in zip(series, usual, strict=True)
    ]
    return (middles - begin) * 1e-9, np.column_stack(columns)


def _mean(series: SignalSeries, edges: np.ndarray, middles: np.ndarray, gap: float) -> np.ndarray:
    which = np.searchsorted(edges, series.t, side="right") - 1
    inside = (which >= 0) & (which < middles.size)
    count = np.bincount(which[inside], minlength=middles.size)
    with np.errstate(all="ignore"):
        mean = np.bincount(which[inside], weights=series.values[inside], minlength=middles.size) / count
    line = np.interp(middles, series.t, series.values)
    after = np.clip(np.searchsorted(series.t, middles), 1, series.t.size - 1)
    line[series.t[after] - series.t[after - 1] > gap] = np.nan
    return np.where(count > 0, mean, line)
