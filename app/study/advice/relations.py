"""Relations between signals: drivers by a first-order lag, and pairs that measure the same quantity or its rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sources.inspect import SignalSeries

from .signals import Signal, common

TRIED_TIME_CONSTANTS = 24
"""Time constants that are tried, from one interval to a third of the recording, evenly by their logarithm."""

MAX_TIME_SHARE = 1.0 / 3.0  # of the length of the recording: of a longer lag it does not show the end

MAX_DRIVERS = 4  # drivers of a signal
ERROR_FACTOR = 0.8  # factor by which more drivers must lower the error on the second half to be worth it
MIN_EXPLAINED = 0.5  # share of the variance of the second half that drivers must explain to be taken
MIN_DRIVER_TIMES = 60  # common times that it takes


class Driven(NamedTuple):
    """A first-order lag, tau · y' = offset + Σ gain · u - y, of a signal y behind others.

    `explained` is the share of the variance of the second half that is simulated, without any reading, with values
    fitted to the first. `start` is how far above the lag the signal began; that decays with tau.
    """

    signal: int
    drivers: tuple[int, ...]
    gains: tuple[float, ...]
    offset: float
    tau: float
    explained: float
    start: float = 0.0


def driven(found: Sequence[Signal], target: int, candidates: Sequence[int]) -> Driven | None:
    """The drivers of a signal among some others, the one that helps most first; None where none explains it.

    For each time constant the driven lag is linear in offset, gains and start, so least squares finds these at once.
    """
    if not candidates:
        return None
    t, values = common([found[target].series, *(found[k].series for k in candidates)])
    there = np.isfinite(values).all(axis=1)
    if there.sum() < MIN_DRIVER_TIMES:
        return None
    # A hole is bridged by what was last there, and not scored.
    y, u = values[:, 0], _held(values[:, 1:])
    half = t.size // 2
    if not (np.nanvar(y[half:]) > 0.0 and np.nanvar(y[:half]) > 0.0):
        return None
    taken: list[int] = []
    sets: list[tuple[float, Driven]] = []
    while len(taken) < min(MAX_DRIVERS, len(candidates)):
        tried = [(_fitted(t, y, u[:, [*taken, k]], half), k) for k in range(len(candidates)) if k not in taken]
        (error, tau, weights), k = min(tried, key=lambda entry: entry[0][0])
        taken.append(k)
        explained = 1.0 - error / float(np.nanvar(y[half:]))
        names, gains = tuple(candidates[k] for k in taken), tuple(float(w) for w in weights[2:])
        sets.append((error, Driven(target, names, gains, float(weights[0]), tau, explained)))
    least = min(error for error, _ in sets)
    best = next(one for error, one in sets if ERROR_FACTOR * error <= least)
    if best.explained < MIN_EXPLAINED:
        return None
    own = u[:, [list(candidates).index(k) for k in best.drivers]]
    from scipy.optimize import minimize_scalar  # 15 MB, which a running twin may never need; with scipy.signal 50 MB

    fine = minimize_scalar(
        lambda log_tau: _lag(t, y, own, half, float(np.exp(log_tau)))[0],
        bounds=np.log([best.tau / 3.0, min(best.tau * 3.0, MAX_TIME_SHARE * float(t[-1] - t[0]))]),
        method="bounded",
    )
    tau = float(np.exp(fine.x))
    _, error, weights = _lag(t, y, own, half, tau)
    gains = tuple(float(w) for w in weights[2:])
    explained = 1.0 - error / float(np.nanvar(y[half:]))
    return best._replace(tau=tau, gains=gains, offset=float(weights[0]), explained=explained, start=float(weights[1]))


def simulated(found: Sequence[Signal], lag: Driven) -> SignalSeries:
    """Return a signal minus its lag behind the drivers, which is simulated without measurements."""
    t, values = common([found[lag.signal].series, *(found[k].series for k in lag.drivers)])
    weights = np.array([lag.offset, lag.start, *lag.gains])
    course = _columns(t, _held(values[:, 1:]), lag.tau) @ weights
    own = found[lag.signal].series
    begin = max(int(found[k].series.t[0]) for k in (lag.signal, *lag.drivers))
    at = np.interp((own.t - begin) * 1e-9, t, course)
    return replace(own, values=own.values - at)


def _held(values: np.ndarray) -> np.ndarray:
    """Return values with NaN replaced by the last known value, or the first at the start."""
    out = values.copy()
    for column in out.T:
        known = np.flatnonzero(np.isfinite(column))
        if known.size:
            column[:] = column[
                known[np.clip(np.searchsorted(known, np.arange(column.size), side="right") - 1, 0, None)]
            ]
    return out


def _fitted(t: np.ndarray, y: np.ndarray, u: np.ndarray, half: int) -> tuple[float, float, np.ndarray]:
    """Mean square error on the second half, time constant, and weights: offset, start, gains."""
    step = float(t[1] - t[0])
    times = np.geomspace(step, max(2.0 * step, MAX_TIME_SHARE * (t[-1] - t[0])), TRIED_TIME_CONSTANTS).tolist()
    tried = [(*_lag(t, y, u, half, tau), tau) for tau in times]
    # The first half alone chooses the time constant.
    _, error, weights, tau = min(tried, key=lambda entry: entry[0])
    return error, tau, weights


def _lag(t: np.ndarray, y: np.ndarray, u: np.ndarray, half: int, tau: float) -> tuple[float, float, np.ndarray]:
    """Mean square errors of one time constant on the first and the second half, and weights, fitted to the first."""
    columns = _columns(t, u, tau)
    early = np.isfinite(y) & (np.arange(t.size) < half)
    late = np.isfinite(y) & (np.arange(t.size) >= half)
    scale = np.maximum(np.abs(columns[early]).max(axis=0), 1e-300)
    weights = np.linalg.lstsq(columns[early] / scale, y[early], rcond=1e-8)[0] / scale
    error = (y - columns @ weights) ** 2
    return float(np.mean(error[early])), float(np.mean(error[late])), weights


def _columns(t: np.ndarray, u: np.ndarray, tau: float) -> np.ndarray:
    """Return the regressors of a lag: offset, start, and each input, held between its times and lagged."""
    from scipy.signal import lfilter

    a = np.exp(-float(t[1] - t[0]) / tau)
    lagged = lfilter([0.0, 1.0 - a], [1.0, -a], u, axis=0, zi=u[:1])[0]
    return np.column_stack([np.ones(t.size), np.exp(-t / tau), lagged])


ALIKE = 0.98
"""Share of the variance of one signal that a line through the other explains, from which on they are much alike."""

NOISY = 0.8  # the same where what is left is white, so that it may be the noise of both
RATE = 0.9  # the same of the changes of one signal by the integral of the other
WHITE = 0.5  # lag-one correlation of the residual above which it is not noise
LAGS = 20  # intervals by which one may follow the other
MIN_PAIR_TIMES = 30  # common times that it takes


class Pair(NamedTuple):
    """`second` = offset + gain · first, `lag` s later, explains the share `explained` of its variance.

    `left` is the standard deviation of the residual, `related` its lag-one correlation; if that is high, they
    are two similar quantities, not two sensors of one.
    With `rate`, offset + gain · second is the speed of `first`, and the variance is that of the first's changes.
    """

    first: int
    second: int
    gain: float
    offset: float
    lag: float
    explained: float
    left: float
    related: float
    rate: bool = False

    @property
    def one(self) -> bool:
        """Whether they may be two sensors of one quantity, differing by noise."""
        return self.rate or self.related < WHITE


def pairs(found: Sequence[Signal]) -> list[Pair]:
    """Return all related pairs among signals, by index."""
    told = []
    for i in range(len(found)):
        for j in range(i + 1, len(found)):
            t, values = common((found[i].series, found[j].series))
            if t.size < MIN_PAIR_TIMES:
                continue
            pair = _alike(i, j, t, values) or _rate(i, j, t, values) or _rate(j, i, t, values[:, ::-1])
            if pair is not None:
                told.append(pair)
    return told


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Gain and offset of y over x, and the share explained; none where one of them stands still."""
    there = np.isfinite(x) & np.isfinite(y)
    x, y = x[there], y[there]
    if x.size < MIN_PAIR_TIMES or not (np.ptp(x) > 0.0 and np.ptp(y) > 0.0):
        return 0.0, 0.0, 0.0
    gain = float(np.cov(x, y)[0, 1] / np.var(x, ddof=1))
    return gain, float(np.mean(y) - gain * np.mean(x)), float(np.corrcoef(x, y)[0, 1] ** 2)


def _related(left: np.ndarray) -> float:
    """Correlation of each value with the next."""
    both = np.isfinite(left[1:]) & np.isfinite(left[:-1])
    one, other = left[:-1][both], left[1:][both]
    return float(np.corrcoef(one, other)[0, 1]) if one.size > 2 and np.ptp(one) > 0.0 and np.ptp(other) > 0.0 else 0.0


def _alike(i: int, j: int, t: np.ndarray, values: np.ndarray) -> Pair | None:
    step = float(t[1] - t[0])
    best: Pair | None = None
    for lag in range(-min(LAGS, t.size // 10), min(LAGS, t.size // 10) + 1):
        x, y = (
            (values[: t.size - lag, 0], values[lag:, 1]) if lag >= 0 else (values[-lag:, 0], values[: t.size + lag, 1])
        )
        gain, offset, explained = _line(x, y)
        # Of two lags that explain alike, the shorter one.
        if best is None or explained > best.explained + 1e-4 * abs(lag):
            left = y - offset - gain * x
            best = Pair(i, j, gain, offset, lag * step, explained, float(np.nanstd(left)), _related(left))
    if best is None or best.explained < NOISY:
        return None
    return best if best.explained >= ALIKE or best.related < WHITE else None


def _rate(i: int, j: int, t: np.ndarray, values: np.ndarray) -> Pair | None:
    """Whether the changes of the first are the integral of the second, over intervals long enough for noise."""
    step = float(t[1] - t[0])
    for over in (1, 5, 20):
        if t.size < 2 * over * MIN_PAIR_TIMES // 10:
            break
        change = values[over:, 0] - values[:-over, 0]
        middle = 0.5 * (values[1:, 1] + values[:-1, 1]) * step
        total = np.cumsum(np.concatenate(([0.0], np.nan_to_num(middle))))
        gain, offset, explained = _line(total[over:] - total[:-over], change)
        if explained >= RATE:
            left = change - offset - gain * (total[over:] - total[:-over])
            a_second = offset / (over * step)
            return Pair(i, j, gain, a_second, 0.0, explained, float(np.nanstd(left)), _related(left), True)
    return None
