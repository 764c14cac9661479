"""Signals of a recording: sample rate, gaps, resolution, noise, common times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from config.fields import repeat_period
from estimators.diagnostics.repeats import SINGLE, RepeatFinding, find_repeats
from estimators.errors import LARGEST
from sources.inspect import RecordingContents, SignalSeries, holes
from sources.mapping import first_of_hold

from ...twin.defaults import rhythm

MIN_VALUES = 20  # values needed to estimate a noise

SKIPPED = re.compile(
    r"time|epoch|utc|date|count|check|crc|valid|status|mode|error|alive|_id$|^id$|parity|accuracy", re.IGNORECASE
)
"""Names that are not measurements."""

DEGREES = ("deg", "°", "degree", "degrees")

MIN_ABSENCES, MIN_ABSENT = 5, 0.2  # absences, and their share of the time, of a signal that comes by chance

MAX_SWITCH_LEVELS = 8  # levels up to which a signal is a switch and no measurement


class Signal(NamedTuple):
    """A signal and properties of its values.

    `rate` is readings a second by the usual interval, NaN with none; `holes` how many gaps far longer than usual, and
    `longest` the longest, s. `resolution` is the smallest step between two values, `levels` how many values there are.
    `noise` is the standard deviation of its roughness, in its unit, at least that of its resolution.
    `kind` is "signal", "switch", "counter", "constant", or "short". `wraps`: an angle in degrees that jumps by a turn;
    its series is in radians, and goes on where the angle jumps. `unit` is that of the recording. `valid` is a flag of
    the same message or table; the series has the values where it is 1. `part` counts the recordings of a merged one.
    `repeats` is how its rows repeat, by `thinned`.
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
    unit: str = ""
    valid: str = ""
    part: int = 0
    repeats: RepeatFinding = RepeatFinding(SINGLE)


VALID = re.compile(r"valid$|^valid", re.IGNORECASE)
"""Names of flags that are 1 where the values beside them can be used."""


def signals(found: RecordingContents) -> list[Signal]:
    """All signals with values, in the order of the recording; those beside a flag of validity where it is 1."""
    every: list[Signal] = []
    for k, part in enumerate(found.parts or (found,)):
        for name, group in [*((m.name, list(m.signals)) for m in part.messages), (None, part.columns)]:
            flags = [one for one in group if VALID.search(one.name) and set(np.unique(one.values)) == {0.0, 1.0}]
            for series in group:
                flag = _flag_of(series, flags, whole=name is not None)
                good = series if flag is None else _where(series, flag)
                used = good if good.values.size else series
                if used.values.size:
                    valid = flag.name if flag is not None and used is not series else ""
                    every.append(signal(name, used)._replace(valid=valid, part=k))
    return every


def _flag_of(series: SignalSeries, flags: Sequence[SignalSeries], *, whole: bool) -> SignalSeries | None:
    """Return the flag of a signal: that with its name, or the only one of its message."""
    if any(one is series for one in flags):
        return None
    stems = {VALID.sub("", one.name).strip("_").lower(): one for one in flags}
    own = next((one for stem, one in stems.items() if stem and series.name.lower().startswith(stem)), None)
    return own or (flags[0] if whole and len(flags) == 1 else stems.get(""))


def _where(series: SignalSeries, flag: SignalSeries) -> SignalSeries:
    """Return the values at the times at which a flag is 1."""
    good = np.isin(series.t, flag.t[flag.values == 1.0])
    return replace(series, t=series.t[good], values=series.values[good])


def signal(message: str | None, series: SignalSeries) -> Signal:
    """Describe one series."""
    unit = series.unit
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
        unit,
    )


def rate_of(t: np.ndarray) -> float:
    """Return the sample rate from the median interval, which gaps do not change; NaN without two times."""
    intervals = np.diff(t)
    intervals = intervals[intervals > 0]
    return 1e9 / float(np.median(intervals)) if intervals.size else np.nan


def comes_by_chance(one: Signal, recorded: np.ndarray) -> bool:
    """Return whether a signal is often away for long, beyond its rate, while the recording goes on at `recorded`."""
    t = one.series.t
    away, paused = (np.diff(holes(each)).ravel() for each in (t, recorded))
    away = away[away > 2e9 * rhythm(t)] if away.size else away
    return away.size >= MIN_ABSENCES + paused.size and bool(away.sum() - paused.sum() > MIN_ABSENT * np.ptp(t))


def thinned(one: Signal) -> Signal:
    """Return a signal with those of its values that are measurements, and how its rows repeat."""
    series, found = one.series, find_repeats(one.series.t, one.series.values)
    if not found.key:
        return one._replace(repeats=found)
    new, _ = first_of_hold(series.t, series.values[:, None], repeat_period(found.key) or 0.0)
    few = signal(one.message, replace(series, t=series.t[new], values=series.values[new]))
    return one._replace(series=few.series, rate=few.rate, noise=few.noise, repeats=found)


def _kind(series: SignalSeries, levels: np.ndarray) -> str:
    if series.values.size < MIN_VALUES:
        return "short"
    if levels.size == 1:
        return "constant"
    if np.abs(levels).max() > LARGEST:
        return "huge"
    if levels.size <= MAX_SWITCH_LEVELS:
        return "switch"
    if SKIPPED.search(series.name) or _counts(series):
        return "counter"
    return "signal"


CLOCK_RATES = (1.0, 1e3, 1e6, 1e9, 1 / 60.0, 1 / 3600.0, 1 / 86400.0)
"""Units of a clock per second: s, ms, us, ns, min, h, days."""


MIN_UNIT_STEPS = 0.9  # Of the steps of a counter, which may start over, as one of four bits


def _counts(series: SignalSeries) -> bool:
    """Return whether a signal is a clock or numbers the rows: its rate is a unit of time, or its steps are 1."""
    if np.mean(np.diff(series.values) == 1.0) > MIN_UNIT_STEPS:
        return True
    seconds = (series.t - series.t[0]) * 1e-9
    if not np.ptp(seconds) > 0.0:
        return False
    rate = (series.values[-1] - series.values[0]) / seconds[-1]
    if not any(abs(rate / unit - 1.0) < 1e-3 for unit in CLOCK_RATES):
        return False
    late = series.values - series.values[0] - rate * seconds
    return bool(np.ptp(late) < 1e-2 * np.ptp(series.values))


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

    If it is a random walk with noisy readings, y = x + v, its differences d have E d² = q dt + 2 r and
    E d_k d_(k+1) = -r. If its speed is a random walk, its second differences e have E e² = ⅔ q dt³ + 6 r and
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
    # Without three times at one interval the differences are taken to be independent, as those of a walk.
    second = max(float(np.mean(e**2)) if e.size else 2.0 * power, floor)
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
    places = np.searchsorted(series.t, np.ceil(edges).astype(np.int64))
    count = np.diff(places)
    with np.errstate(all="ignore"):
        mean = np.add.reduceat(np.append(series.values, 0.0), places)[:-1] / count
    line = np.interp(middles, series.t, series.values)
    after = np.clip(np.searchsorted(series.t, middles), 1, series.t.size - 1)
    line[series.t[after] - series.t[after - 1] > gap] = np.nan
    return np.where(count > 0, mean, line)


MIN_CYCLES = 10  # cycles in a recording, from which on they are one
MIN_LINE = 25.0  # power of a spectral line over its surroundings, which noise reaches once in e^25 frequencies
LINE_BINS, NEAR_BINS = 2, 20  # frequencies on each side that belong to a line, and its surroundings


def cycle_of(series: SignalSeries) -> tuple[float, float] | None:
    """Return period (s) and amplitude of a cycle that a signal repeats all the time, as of days; None without one.

    The periodogram of the differences, whose spectrum is nearly flat where that of a wandering signal is not, has a
    line there. Periods below 8 intervals are no cycle of the asset.
    """
    t, values = common([series])
    known = np.isfinite(values[:, 0]) if t.size else np.zeros(0, np.bool_)
    if known.sum() < 2 * NEAR_BINS * MIN_CYCLES:
        return None
    y = np.interp(t, t[known], values[known, 0])
    d = np.diff(y)
    power = np.abs(np.fft.rfft((d - d.mean()) * np.hanning(d.size))) ** 2
    best, place = 0.0, 0
    for k in range(MIN_CYCLES, power.size // 4):
        sides = power[max(1, k - NEAR_BINS) : k - LINE_BINS], power[k + LINE_BINS + 1 : k + NEAR_BINS + 1]
        # The median of a periodogram of noise is ln 2 of its mean.
        line = power[k] / max(*(float(np.median(side)) / np.log(2.0) for side in sides), 1e-300)
        if line > best:
            best, place = line, k
    if best < MIN_LINE:
        return None
    period = (t[-1] - t[0]) / place * (1.0 + 1.0 / t.size)
    turn = 2.0 * np.pi * t / period
    wave = np.column_stack((np.cos(turn), np.sin(turn), np.ones(t.size), t))[known]
    weights = np.linalg.lstsq(wave, y[known], rcond=None)[0]
    return float(period), float(np.hypot(weights[0], weights[1]))
