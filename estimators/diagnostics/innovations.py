"""Innovations as pictures show them: how they are distributed beside N(0, 1), and what each says of the later ones.

All take one row's standardised innovations e (T,), see `calibration.standardised`; NaN is a missing one, which keeps
its place in time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from ..numerics.quantiles import normal_quantile

TWO_SIDED = normal_quantile(0.975)
"""Standard errors to either side of a 95 % interval."""


class Autocorrelation(NamedTuple):
    """Correlations r (K,) at lags 1 to K, and the 95 % bound to either side of zero for a white series."""

    r: np.ndarray
    bound: float


class Histogram(NamedTuple):
    """Counts (B,) in bins of equal width from `low` to `high`; what lies beyond is counted in the outer bins."""

    low: float
    high: float
    counts: np.ndarray


class Ranks(NamedTuple):
    """Counts (B,) in bins of equal probability, and the 95 % range of each count if all are equally likely."""

    counts: np.ndarray
    low: float
    high: float


def autocorrelation(e: np.ndarray, lags: int) -> Autocorrelation:
    """The sample autocorrelation.

    r_k = Σ z_t z_{t+k} / Σ z_t²,  bound = 1.96 / √n,

    z being the series less its mean (0 where missing), n its values. NaN where it is constant, or no longer than a lag.

    Source: Box, Jenkins & Reinsel, Time Series Analysis (1994), 2.1.5 and 2.1.6.
    """
    there = np.isfinite(e)
    n = int(there.sum())
    z = np.where(there, e - np.mean(e[there]), 0.0) if n else np.zeros(e.size)
    square = float(z @ z)
    r = np.full(lags, np.nan)
    if square > 0.0:
        for k in range(1, min(lags, e.size - 1) + 1):
            r[k - 1] = z[k:] @ z[:-k] / square
    return Autocorrelation(r, TWO_SIDED / np.sqrt(n) if n else np.nan)


def histogram(e: np.ndarray, low: float = -4.0, high: float = 4.0, bins: int = 32) -> Histogram:
    """How often e lies where."""
    inside = np.clip(e[np.isfinite(e)], low, np.nextafter(high, low))
    counts, _ = np.histogram(inside, bins, (low, high))
    return Histogram(low, high, counts)


def quantile_pairs(e: np.ndarray, most: int = 60) -> np.ndarray:
    """Points (k, 2) of a Q-Q plot: what a normal variable has at a probability, and what e has; k ≤ `most`.

    The i-th smallest of n stands at (i - ½) / n; of many the outermost are shown, and some at even steps of the normal
    quantile between.
    """
    z = np.sort(e[np.isfinite(e)])
    n = z.size
    if n > most:
        wanted = ndtr(np.linspace(ndtri(0.5 / n), ndtri(1.0 - 0.5 / n), most))
        rows = np.unique(np.clip(np.rint(wanted * n - 0.5).astype(int), 0, n - 1))
    else:
        rows = np.arange(n)
    return np.stack((ndtri((rows + 0.5) / n), z[rows]), axis=1) if n else np.zeros((0, 2))


def rank_histogram(e: np.ndarray, bins: int = 10) -> Ranks:
    """In which of the bins each reading lay among what was predicted: Φ(e), flat where the prediction is right.

    A U shape says that the spread is too small, a hump that it is too large, a slope that there is a bias.

    Source: Hamill (2001), doi:10.1175/1520-0493(2001)129<0550:IORHFV>2.0.CO;2, with the predictive distribution in
    place of its members.
    """
    share = ndtr(e[np.isfinite(e)])
    counts = np.bincount(np.minimum((bins * share).astype(int), bins - 1), minlength=bins)
    return Ranks(counts, *flat_range(share.size, bins))


def flat_range(n: int, bins: int) -> tuple[float, float]:
    """The 95 % range of the count in one of so many equally likely bins, of n draws."""
    half = TWO_SIDED * np.sqrt(n * (bins - 1.0)) / bins
    return n / bins - half, n / bins + half


def memory(r: np.ndarray) -> int:
    """After how many readings a correlation has fallen to a third of the first; as many as are known if it has not."""
    fallen = np.flatnonzero(r < r[0] / 3.0) if r.size else np.zeros(0, int)
    return int(fallen[0]) + 1 if fallen.size else r.size
