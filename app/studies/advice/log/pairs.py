"""Which signals say the same: two sensors of one quantity, or one the rate of the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .grid import common
from .signals import Signal

ALIKE = 0.98
"""Share of the variance of one signal that a line through the other explains, from which on they are much alike."""

NOISY = 0.8
"""The same where what is left is white, so that it may be the noise of both."""

RATE = 0.9
"""The same of the changes of one signal by the integral of the other."""

WHITE = 0.5
"""Correlation of what is left with the next, beyond which it is no noise."""

LAGS = 20
"""Intervals by which one may follow the other."""

LEAST = 30
"""Common times that it takes."""


class Pair(NamedTuple):
    """`second` = offset + gain · first, `lag` s later, explains the share `explained` of its variance.

    `left` is the standard deviation of what is left of the second, `related` its correlation with the next: where that
    is high they are two quantities that are much alike, and not two sensors of one.
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
        """Whether they may be two sensors of one quantity: what differs is noise."""
        return self.rate or self.related < WHITE


def pairs(found: Sequence[Signal]) -> list[Pair]:
    """All pairs among some signals, by their indices; of equal ones the first is the one with less noise."""
    told = []
    for i in range(len(found)):
        for j in range(i + 1, len(found)):
            t, values = common((found[i].series, found[j].series))
            if t.size < LEAST:
                continue
            pair = _alike(i, j, t, values) or _rate(i, j, t, values) or _rate(j, i, t, values[:, ::-1])
            if pair is not None:
                told.append(pair)
    return told


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Gain and offset of y over x, and the share explained; none where one of them stands still."""
    there = np.isfinite(x) & np.isfinite(y)
    x, y = x[there], y[there]
    if x.size < LEAST or not (np.ptp(x) > 0.0 and np.ptp(y) > 0.0):
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
        if t.size < 2 * over * LEAST // 10:
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
