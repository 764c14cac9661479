"""Cost of a filter step, arrivals of measurements, and whether a linearised filter suits the model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...fold import Fold, folded
from ...log import READING, Log
from ...model.state_space import LARGE, StateSpaceModel
from ...numerics.linalg import wrapped
from ...registry import find_entry, unfit
from ...track import GATED, USED, Track
from ...tuning import Tuning
from ..calibration import LIMITS, standardised
from ..innovations import ljung_box
from ..intervals import Interval, correlation_interval
from .responses import MAX_STATES, digits, each

SPREAD_TOLERANCE = 0.1  # Relative Monte Carlo error of the standard deviations of an ensemble

MAX_PROCESSOR_SHARE = 0.5
"""Share of one processor that an estimate may take: the rest is for late readings and for refolds."""


class Dimension(NamedTuple):
    """Cost of a filter step, and of the alternatives.

    flops: of a covariance step of n states and m rows, 4 n³ for F P Fᵀ and 6 m n² for the update; memory: of the
    covariance, bytes. share: of one processor, at `rate` measurements a second and `seconds` a measurement. largest: n
    at which a covariance would take the whole processor, if the cost grew with n³. members: ensemble whose σ has a
    Monte Carlo error of 10 %, 1 / √(2 (m - 1)). passes: `share` is at most a half, and the covariance can be formed.
    """

    nx: int
    rows: int
    flops: float
    memory: float
    rate: float
    seconds: float
    share: float
    largest: float
    members: int
    passes: bool


def dimension(model: StateSpaceModel, rate: float, seconds: float, *, covariance: bool) -> Dimension:
    """Return the cost of a filter step.

    Args:
        model: The model.
        rate: Measurements per second.
        seconds: Measured time of the filter per measurement, with the events between.
        covariance: Whether the filter has a covariance.
    """
    n = model.nx
    rows = max(len(sensor.rows) for sensor in model.sensors)
    share = rate * seconds
    members = int(np.ceil(1.0 + 0.5 / SPREAD_TOLERANCE**2))
    return Dimension(
        nx=n,
        rows=rows,
        flops=4.0 * n**3 + 6.0 * rows * n**2,
        memory=8.0 * n**2,
        rate=rate,
        seconds=seconds,
        share=share,
        largest=n * share ** (-1.0 / 3.0) if covariance and share > 0.0 else np.nan,
        members=members,
        passes=share <= MAX_PROCESSOR_SHARE and (n <= LARGE or not covariance),
    )


def spread_error(members: float) -> float:
    """Return the relative standard error of the standard deviation of m normal members, 1 / √(2 (m - 1))."""
    return float(1.0 / np.sqrt(2.0 * (members - 1.0))) if members > 1.0 else np.inf


QUANTILES = (0.5, 0.99, 1.0)  # Of lateness


class Arrivals(NamedTuple):
    """Measurements of one sensor.

    period: median time between two, s; rate: its inverse. gap: longest time without a measurement, s, from `gap_at` (s
    of the log) on. missing: share of measurements that are absent at this period, or have no finite value. lateness
    (3,): `QUANTILES` of arrival minus time of measurement, s; NaN where arrivals are not known.
    """

    sensor: str
    n: int
    period: float
    rate: float
    gap: float
    gap_at: float
    missing: float
    lateness: np.ndarray


def arrivals(model: StateSpaceModel, log: Log) -> tuple[Arrivals, ...]:
    """Return the arrivals of every sensor; n = 0 for sensors that never report."""
    t, reading = log.events.t, log.events.kind == READING
    # Files hold times of measurement only, so arrival equals time there.
    known = bool(np.any(log.events.arrival[reading] != t[reading]))
    found = []
    for s, sensor in enumerate(model.sensors):
        own = log.events.of_sensor(s)
        there = np.isfinite(log.value[own, : len(sensor.rows)]).any(axis=1)
        times = np.unique(t[own[there]])
        apart = np.diff(times) * 1e-9
        late = np.full(len(QUANTILES), np.nan)
        if known and own.size:
            late = np.quantile((log.arrival[own] - t[own]) * 1e-9, QUANTILES)
        period, gap, at, missing = np.nan, np.nan, np.nan, np.nan
        if apart.size:
            period = float(np.median(apart))
            longest = int(np.argmax(apart))
            gap, at = float(apart[longest]), float(times[longest]) * 1e-9
            expected = np.round(apart.sum() / period) + 1.0
            missing = float(max(0.0, 1.0 - times.size / expected))
        rate = 1.0 / period if period > 0.0 else np.nan
        found.append(Arrivals(sensor.name, int(there.sum()), period, rate, gap, at, missing, late))
    return tuple(found)


MIN_DIFFERENCE = 0.001  # Smallest share of σ that is reported

DIFFERENCE_QUANTILE = 0.95
"""Quantile of the differences along the track; a few at the start, with the spread of the prior, do not matter."""

LINEARISED, UNSCENTED = "ekf", "ukf"


class Curvature(NamedTuple):
    """Difference of the two filters in a state or in the prediction of a sensor row, in σ: RMS and quantile."""

    name: str
    rms: float
    most: float


class White(NamedTuple):
    """Innovations of one sensor row: correlation with the next and p-value of Ljung-Box, of both filters."""

    row: str
    linearised: Interval
    unscented: Interval
    p_linearised: float
    p_unscented: float


class Linearity(NamedTuple):
    """Whether a linearised model passes; `passes` is None where it cannot be determined, for the `reason`.

    exact: f and h are declared linear, so the Kalman filter makes no error. white: the innovations of the linearised
    filter have no relevant correlation. text: the verdict in words.
    """

    reason: str
    exact: bool
    passes: bool | None
    white: bool
    states: tuple[Curvature, ...]
    rows: tuple[Curvature, ...]
    whiteness: tuple[White, ...]
    text: str


def linearity(model: StateSpaceModel, tuning: Tuning, log: Log) -> Linearity:
    """Fold a log with the extended and the unscented Kalman filter.

    Args:
        model: Of at most 64 states, to which both apply.
        tuning: As the twin's, without the options of its filter.
        log: The events; it must not grow meanwhile (give a copy).

    Raises:
        EstimatorError: As `Fold`.
        ModelError: As `Fold`.
    """
    reason = _reason_against(model)
    if reason:
        return Linearity(reason, model.linear, None, False, (), (), (), reason)
    plain = tuning.with_options({})
    straight, curved = each(lambda name: folded(name, model, plain, log), (LINEARISED, UNSCENTED), "threads")
    states = _states(straight, curved)
    rows, whiteness = _rows(straight, curved)
    passes = all(item.most <= LIMITS.bias for item in (*states, *rows))
    bad = [item for item in whiteness if item.linearised.beyond(-LIMITS.correlation, LIMITS.correlation)]
    text = _in_words(model.linear, states + rows, bad)
    return Linearity("", model.linear, passes, not bad, states, rows, whiteness, text)


def _reason_against(model: StateSpaceModel) -> str:
    if model.grid is not None or model.nx > MAX_STATES:
        return f"{model.name} has {model.nx:,} states; a linearised model is tried up to {MAX_STATES}"
    for name in (LINEARISED, UNSCENTED):
        unsuited = unfit(find_entry(name), model)
        if unsuited:
            return f"{name} does not apply: {unsuited}"
    return ""


def _curvature(name: str, apart: np.ndarray) -> Curvature:
    """Return RMS and quantile of differences in σ; infinite where only one of the filters has a finite estimate."""
    there = apart[~np.isnan(apart)]
    if not there.size:
        return Curvature(name, 0.0, 0.0)
    return Curvature(name, float(np.sqrt(np.mean(there**2))), float(np.quantile(there, DIFFERENCE_QUANTILE)))


def _apart(one: np.ndarray, other: np.ndarray, std: np.ndarray, circular: bool) -> np.ndarray:
    difference = wrapped(one - other, circular)
    with np.errstate(all="ignore"):
        share = np.abs(difference) / std
    lost = np.isfinite(other) & ~np.isfinite(one)
    # Without uncertainty, rounding does not count as a difference.
    share = np.where((std == 0.0) & (np.abs(difference) <= 1e-9 * np.maximum(1.0, np.abs(other))), 0.0, share)
    return np.where(lost, np.inf, share)


def _states(straight: Fold, curved: Fold) -> tuple[Curvature, ...]:
    model, one, other = straight.model, straight.track, curved.track
    return tuple(
        _curvature(state.name, _apart(one.mean[:, k], other.mean[:, k], other.std[:, k], state.circular))
        for k, state in enumerate(model.shown_states)
    )


def _rows(straight: Fold, curved: Fold) -> tuple[tuple[Curvature, ...], tuple[White, ...]]:
    model, log = straight.model, straight.log
    found, whiteness = [], []
    for s, sensor in enumerate(model.sensors):
        own = log.events.of_sensor(s)
        if not own.size:
            continue
        one, other = straight.track.select(own), curved.track.select(own)
        for k, row in enumerate(sensor.rows):
            name = model.row_names[model.row_start[s] + k]
            apart = _apart(one.innovation[:, k], other.innovation[:, k], other.innovation_std[:, k], row.circular)
            found.append(_curvature(name, apart))
            series = [_judged(track, k) for track in (one, other)]
            first, second = (correlation_interval(e[np.isfinite(e)]) for e in series)
            p_first, p_second = (ljung_box(e).p_value for e in series)
            whiteness.append(White(name, first, second, p_first, p_second))
    return tuple(found), tuple(whiteness)


def _judged(track: Track, k: int) -> np.ndarray:
    """Return the standardised innovations of the measurements that were used or rejected; NaN elsewhere."""
    judged = (track.verdict == USED) | (track.verdict == GATED)
    return np.where(judged, standardised(track, k, False), np.nan)


def _in_words(exact: bool, apart: tuple[Curvature, ...], bad: list[White]) -> str:
    worst = max(apart, key=lambda item: item.most)
    most = f"less than {MIN_DIFFERENCE:g} σ" if worst.most < MIN_DIFFERENCE else f"at most {digits(worst.most)} σ"
    figure = (
        f"{100 * DIFFERENCE_QUANTILE:.0f} % of the time {LINEARISED} and {UNSCENTED} are {most} apart ({worst.name})"
    )
    if exact:
        figure = f"f and h are linear, so the Kalman filter is exact; {figure}"
    elif worst.most <= LIMITS.bias:
        figure = f"a linearised model passes: {figure}"
    else:
        figure = f"a linearised model does not pass: {figure}, more than {LIMITS.bias:g} σ"
    if not bad:
        return f"{figure}; innovations of {LINEARISED} show no correlation beyond {LIMITS.correlation:g}"
    first = max(bad, key=lambda item: abs(item.linearised.value))
    if abs(first.linearised.value) - abs(first.unscented.value) > LIMITS.correlation:
        why = "the linearisation is to blame"
    elif worst.most <= LIMITS.bias:
        why = "so model or Q are off, not the linearisation"
    else:
        why = "so neither of them fits"
    return (
        f"{figure}; innovations are not white: {first.row} {first.linearised.value:+.2f} with {LINEARISED}, "
        f"{first.unscented.value:+.2f} with {UNSCENTED}, {why}"
    )
