"""Intervals of means and shares of values that may be correlated in time, and of any distribution.

The variance of a mean is 1/T of the long-run variance Ω of the series, its spectrum at frequency zero. It is estimated
by the series' projections on a few slow cosines, whose number is the degrees of freedom of Student's t. With few
cosines the interval is 10 % wider than necessary for a white series, and valid if the correlation decays within about
1 % of the series.

Source: Lazarus, Lewis, Stock & Watson (2018), doi:10.1080/07350015.2018.1506926, "EWC".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.fft import dct
from scipy.special import stdtrit

PROBABILITY = 0.95  # Of every interval here
N_COSINES = 12  # Projections; fewer for a series that has not twice as many values
MIN_VALUES = 8  # Values that an interval takes at least


class Interval(NamedTuple):
    """An estimate and its 95 % interval; all NaN, or the bounds, where there are too few values."""

    value: float
    low: float
    high: float

    def beyond(self, low: float, high: float) -> bool:
        """Return whether the whole interval lies below `low` or above `high`."""
        return bool(self.high < low or self.low > high)


UNKNOWN = Interval(np.nan, np.nan, np.nan)


def long_run_variance(x: np.ndarray) -> tuple[float, int]:
    """Return Ω of a series (T,), and its degrees of freedom B.

    Ω = 1/B Σ_j Λ_j²,  Λ_j = √(2/T) Σ_t x_t cos(π j (t + ½) / T),  j = 1 to B
    """
    count = min(N_COSINES, x.size // 2)
    # The transform is twice the sum, and the cosines are orthogonal to a constant.
    projections = dct(x - np.mean(x), type=2)[1 : count + 1] / np.sqrt(2.0 * x.size)
    return float(np.mean(projections**2)), count


def _half(degrees: int) -> float:
    """Return the half width in standard errors."""
    return float(stdtrit(degrees, 0.5 + 0.5 * PROBABILITY))


def mean_interval(x: np.ndarray) -> Interval:
    """Return the mean of a series (T,) of finite values in order of time."""
    if x.size < MIN_VALUES:
        return Interval(float(np.mean(x)), np.nan, np.nan) if x.size else UNKNOWN
    variance, degrees = long_run_variance(x)
    mean, half = float(np.mean(x)), _half(degrees) * np.sqrt(variance / x.size)
    return Interval(mean, mean - half, mean + half)


def scale_interval(x: np.ndarray) -> Interval:
    """Return the mean of a series (T,) of non-negative values, with a proportional, always positive interval."""
    found = mean_interval(x)
    if not found.value > 0.0:
        return found
    factor = float(np.exp((found.high - found.value) / found.value))
    return Interval(found.value, found.value / factor, found.value * factor)


def share_interval(inside: np.ndarray, like: np.ndarray) -> Interval:
    """Return the share of True in a series (T,), by Wilson's interval for the effective number of independent values.

    Args:
        inside: Boolean, (T,).
        like: Values from which `inside` was computed, (T,); their correlation counts where `inside` is constant.

    Source: Wilson (1927), doi:10.1080/01621459.1927.10502953.
    """
    n = inside.size
    if not n:
        return UNKNOWN
    share = float(np.mean(inside))
    if n < MIN_VALUES:
        return Interval(share, np.nan, np.nan)
    # Squares keep their correlation where the sign of the values alternates.
    independent, degrees = _independent(inside.astype(float) if 0.0 < share < 1.0 else like**2)
    square = _half(degrees) ** 2
    centre = (share + square / (2.0 * independent)) / (1.0 + square / independent)
    half = np.sqrt(square * (share * (1.0 - share) / independent + square / (4.0 * independent**2)))
    half /= 1.0 + square / independent
    # Rounding must put neither the share outside, nor an end beyond 0 and 1.
    low, high = np.clip((centre - half, centre + half), 0.0, 1.0)
    return Interval(share, float(min(share, low)), float(max(share, high)))


def correlation_interval(x: np.ndarray) -> Interval:
    """Return the correlation of each value of a series (T,) with the next, about its mean.

    r = Σ z_t z_{t+1} / Σ z_t²; its interval is that of the mean contribution of a pair,
    (z_t z_{t+1} - r (z_t² + z_{t+1}²) / 2) / mean z².
    """
    z = x - np.mean(x) if x.size else x
    square = float(np.mean(z**2)) if x.size else 0.0
    if x.size <= MIN_VALUES or not square > 0.0:
        return UNKNOWN
    products, squares = z[1:] * z[:-1], 0.5 * (z[1:] ** 2 + z[:-1] ** 2)
    r = float(np.sum(products) / (x.size * square))
    spread = mean_interval((products - r * squares) / square)
    half = spread.high - spread.value
    return Interval(r, max(-1.0, r - half), min(1.0, r + half))


def _independent(x: np.ndarray) -> tuple[float, int]:
    """Return the effective number of independent values of a series (T,), at most T, and the degrees of freedom."""
    variance, degrees = long_run_variance(x)
    own = float(np.var(x))
    return (float(np.clip(x.size * own / variance, 1.0, x.size)) if variance > 0.0 else float(x.size)), degrees
