"""Statistics of innovations: distribution against N(0, 1), autocorrelation, tests of whiteness, and their size.

Arguments are one row's standardised innovations e (T,), see `calibration.standardised`; NaN for missing ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtr, chdtrc, ndtr, ndtri

from ..log import READING, Events
from ..numerics.quantiles import chi_square_quantile, normal_quantile
from ..track import GATED, USED, Track
from ..tuning import Tuning
from .intervals import correlation_interval

TWO_SIDED = normal_quantile(0.975)  # Standard errors to either side of a 95 % interval


class Autocorrelation(NamedTuple):
    """Correlations r (K,) at lags 1 to K, and the 95 % bound to either side of zero for a white series."""

    r: np.ndarray
    bound: float


class Histogram(NamedTuple):
    """Counts (B,) in bins of equal width from `low` to `high`; the outer bins also count values beyond."""

    low: float
    high: float
    counts: np.ndarray


class Ranks(NamedTuple):
    """Counts (B,) in bins of equal probability, and the 95 % range of each count if all are equally likely."""

    counts: np.ndarray
    low: float
    high: float


def autocorrelation(e: np.ndarray, lags: int) -> Autocorrelation:
    """Return the sample autocorrelation.

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
    """Return the histogram of e."""
    inside = np.clip(e[np.isfinite(e)], low, np.nextafter(high, low))
    counts, _ = np.histogram(inside, bins, (low, high))
    return Histogram(low, high, counts)


def quantile_pairs(e: np.ndarray, most: int = 60) -> np.ndarray:
    """Return points (k, 2) of a Q-Q plot: quantiles of a normal variable and of e; k ≤ `most`.

    The i-th smallest of n is at (i - ½) / n. Of many values, those at even steps of the normal quantile are returned.
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
    """Return the histogram of Φ(e), flat if the predictive distribution is right.

    A U shape means that the spread is too small, a hump that it is too large, a slope a bias.

    Source: Hamill (2001), doi:10.1175/1520-0493(2001)129<0550:IORHFV>2.0.CO;2, with the predictive distribution in
    place of its members.
    """
    share = ndtr(e[np.isfinite(e)])
    counts = np.bincount(np.minimum((bins * share).astype(int), bins - 1), minlength=bins)
    return Ranks(counts, *flat_range(share.size, bins))


def flat_range(n: int, bins: int) -> tuple[float, float]:
    """Return the 95 % range of the count in one of `bins` equally likely bins, for n draws."""
    half = TWO_SIDED * np.sqrt(n * (bins - 1.0)) / bins
    return n / bins - half, n / bins + half


def memory(r: np.ndarray) -> int:
    """Return the lag at which a correlation has fallen to a third of the first; the largest lag if it has not."""
    fallen = np.flatnonzero(r < r[0] / 3.0) if r.size else np.zeros(0, int)
    return int(fallen[0]) + 1 if fallen.size else r.size


MIN_INNOVATIONS = 50  # Readings of a row from which on its noise is estimated


class SensorNoise(NamedTuple):
    """Variance of the noise of one sensor row, estimated from n innovations, in the square of the row's unit.

    variance: not positive where the innovations are smaller than process noise and model explain; std: its standard
    deviation for white, normal innovations. correlation: lag 1; chance: p-value of a Ljung-Box test. Where that is
    small, the innovations are not white, and the variance is not that of noise.
    """

    variance: float
    std: float
    n: int
    correlation: float = 0.0
    chance: float = 1.0


def mean_nis(track: Track, gate: float | None) -> float:
    """Return the mean NIS per degree of freedom of used and rejected measurements, 1 for a consistent filter.

    Args:
        track: The track.
        gate: Gate of the tuning; None without one.

    Returns:
        NaN without measurements.
    """
    judged = (track.verdict == USED) | (track.verdict == GATED)
    nis, dof = track.nis[judged], track.dof[judged]
    m, g = _gates(gate, dof)
    expected = _expected(g, m)[dof].sum()
    return float(np.minimum(nis, g[dof]).sum() / expected) if expected > 0.0 else np.nan


def sensor_noise(track: Track, events: Events, tuning: Tuning) -> dict[str, SensorNoise]:
    """Return the noise of the sensor rows with enough measurements, estimated from their innovations ν.

    R̂ = mean ν² - (S - R), the variance of the innovations minus that of the prediction, H P⁻ Hᵀ. Measurements have the
    weight 1 / S², the inverse of the variance of ν², so those predicted from a wide prior count little. All excess of
    the innovations is attributed to R, so the estimate is valid only if they are white: with a Q that is too small, or
    a slow error of model or sensor, it is too large. P⁻ depends on R; iterated, the estimate converges.

    Args:
        track: A track with this tuning.
        events: Its events, without variances of their own.
        tuning: The tuning; the filter must not adapt R.

    Source: Mohamed & Schwarz (1999), doi:10.1007/s001900050236, the R of the innovation-based filter; after Mehra
    (1970), doi:10.1109/TAC.1970.1099422.
    """
    model, found = tuning.model, dict[str, SensorNoise]()
    judged = (events.kind == READING) & ((track.verdict == USED) | (track.verdict == GATED))
    for s, sensor in enumerate(model.sensors):
        rows = np.flatnonzero(judged & (events.channel == s))
        dof = track.dof[rows]
        _, g = _gates(tuning.gate, dof)
        expected = _expected(g, np.ones(len(g)))
        for k in range(len(sensor.rows)):
            nu, S = track.innovation[rows, k], track.innovation_std[rows, k] ** 2
            known = np.isfinite(nu) & np.isfinite(S) & (S > 0.0)
            n = int(known.sum())
            if n < MIN_INNOVATIONS:
                continue
            nu, S, m = nu[known], S[known], dof[known]
            R = float(tuning.r[model.row_start[s] + k])
            square = np.minimum(nu**2, g[m] * S) / expected[m]
            weight = S**-2
            excess = float(np.sum(weight * (square - S)) / np.sum(weight))
            std = float(np.sqrt(2.0 / np.sum(weight)))
            e = np.where(known, track.innovation[rows, k], np.nan) / track.innovation_std[rows, k]
            limit = np.sqrt(g[dof])
            e = np.clip(e, -limit, limit)
            correlation, chance = correlation_interval(e[known]).value, ljung_box(e).p_value
            found[model.row_names[model.row_start[s] + k]] = SensorNoise(R + excess, std, n, correlation, chance)
    return found


def _gates(gate: float | None, dof: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the degrees of freedom up to the largest, and their gates: quantiles are expensive, and few differ."""
    m = np.arange(1.0 + dof.max(initial=0))
    return m, np.full(m.size, np.inf) if gate is None else chi_square_quantile(gate, m)


def _expected(g: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Return E min(χ²_m, g) of each; m without a gate."""
    finite = np.isfinite(g)
    limit = np.where(finite, g, 1.0)
    return np.where(finite, m * chdtr(m + 2.0, limit) + limit * chdtrc(m, limit), m)


class WhitenessTest(NamedTuple):
    """A statistic, its p-value, and the degrees of freedom of its chi-square distribution.

    Statistic and p-value are NaN if the series is too short, or constant.
    """

    statistic: float
    p_value: float
    dof: int


def ljung_box(innovations: np.ndarray, lags: int | None = None) -> WhitenessTest:
    """Test whether a series is correlated at lags 1 to `lags`.

    Q = n (n + 2) Σ_k r_k² / n_k,  r_k = Σ z_t z_{t+k} / Σ z_t²,  chi-square with `lags` degrees of freedom,

    z being the series less its mean (0 where missing), n the number of its finite values and n_k that of the finite
    pairs at lag k: under the null the variance of r_k is n_k / (n (n + 2)). Without missing values n_k is n - k.

    Args:
        innovations: Standardised innovations, (T,); NaN is a missing one.
        lags: Number of lags; None for 10, or a fifth of the values if that is less.

    Raises:
        ValueError: If `lags` is not positive.

    Source: Ljung & Box (1978), doi:10.1093/biomet/65.2.297.
    """
    there = np.isfinite(innovations)
    n = int(there.sum())
    lags = max(1, min(10, n // 5)) if lags is None else lags
    if lags < 1:
        raise ValueError(f"lags is {lags}; it must be 1 or more")
    pairs = np.array([np.sum(there[k:] & there[:-k]) for k in range(1, lags + 1)])
    r = autocorrelation(innovations, lags).r
    if not np.all(np.isfinite(r)) or not np.all(pairs):
        return WhitenessTest(np.nan, np.nan, lags)
    statistic = float(n * (n + 2) * np.sum(r**2 / pairs))
    return WhitenessTest(statistic, float(chdtrc(lags, statistic)), lags)


def jarque_bera(innovations: np.ndarray) -> WhitenessTest:
    """Test of normality by the skewness S and kurtosis K of the finite values.

    JB = n (S² / 6 + (K - 3)² / 24),  chi-square with 2 degrees of freedom

    Args:
        innovations: Standardised innovations, (T,); NaN is a missing one.

    Source: Jarque & Bera (1980), doi:10.1016/0165-1765(80)90024-5.
    """
    z = innovations[np.isfinite(innovations)]
    z = z - np.mean(z) if z.size else z
    variance = float(np.mean(z**2)) if z.size else 0.0
    if not variance > 0.0:
        return WhitenessTest(np.nan, np.nan, 2)
    skewness, kurtosis = np.mean(z**3) / variance**1.5, np.mean(z**4) / variance**2
    statistic = float(z.size * (skewness**2 / 6.0 + (kurtosis - 3.0) ** 2 / 24.0))
    return WhitenessTest(statistic, float(chdtrc(2, statistic)), 2)
