"""Textbook tests of standardised innovations: correlated, not normal, or of a variance that changes.

Each tests one series under the null that it is white and normal with one variance. Missing values (NaN) keep their
place in time. With enough readings every real series fails each of them: they say whether something is off, not
whether it matters, which calibration.py does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtr, fdtrc


class WhitenessTest(NamedTuple):
    """A statistic, the chance of one as large under the null, and the degrees of freedom of its distribution.

    `dof` has one number for a chi-square, two (numerator, denominator) for an F. Statistic and p-value are NaN where
    the series is too short, or constant.
    """

    statistic: float
    p_value: float
    dof: tuple[int, ...]


def ljung_box(innovations: np.ndarray, lags: int | None = None) -> WhitenessTest:
    """Whether a series is correlated at lags 1 to `lags`.

    Q = n (n + 2) Σ_k r_k² / n_k,  r_k = Σ z_t z_{t+k} / Σ z_t²,  chi-square with `lags` degrees of freedom,

    z being the series less its mean (0 where missing), n its values that are there and n_k the pairs, k apart, of which
    both are: under the null the variance of r_k is n_k / (n (n + 2)). Where nothing is missing n_k is n - k.

    Args:
        innovations: Standardised innovations, (T,); NaN is a missing one.
        lags: How many; None for 10, or a fifth of the values where that is less.

    Raises:
        ValueError: If `lags` is not positive.

    Source: Ljung & Box (1978), doi:10.1093/biomet/65.2.297.
    """
    there = np.isfinite(innovations)
    n = int(there.sum())
    lags = max(1, min(10, n // 5)) if lags is None else lags
    if lags < 1:
        raise ValueError(f"lags is {lags}; it must be 1 or more")
    z = np.where(there, innovations - np.mean(innovations[there]), 0.0) if n else np.zeros(len(innovations))
    square = float(z @ z)
    pairs = np.array([np.sum(there[k:] & there[:-k]) for k in range(1, lags + 1)])
    if not square > 0.0 or not np.all(pairs):
        return WhitenessTest(np.nan, np.nan, (lags,))
    r = np.array([z[k:] @ z[:-k] for k in range(1, lags + 1)]) / square
    statistic = float(n * (n + 2) * np.sum(r**2 / pairs))
    return WhitenessTest(statistic, float(chdtrc(lags, statistic)), (lags,))


def jarque_bera(innovations: np.ndarray) -> WhitenessTest:
    """Whether the values are normal, by skewness S and kurtosis K of those that are there.

    JB = n (S² / 6 + (K - 3)² / 24),  chi-square with 2 degrees of freedom

    Args:
        innovations: Standardised innovations, (T,); NaN is a missing one.

    Source: Jarque & Bera (1980), doi:10.1016/0165-1765(80)90024-5.
    """
    z = innovations[np.isfinite(innovations)]
    z = z - np.mean(z) if z.size else z
    variance = float(np.mean(z**2)) if z.size else 0.0
    if not variance > 0.0:
        return WhitenessTest(np.nan, np.nan, (2,))
    skewness, kurtosis = np.mean(z**3) / variance**1.5, np.mean(z**4) / variance**2
    statistic = float(z.size * (skewness**2 / 6.0 + (kurtosis - 3.0) ** 2 / 24.0))
    return WhitenessTest(statistic, float(chdtrc(2, statistic)), (2,))


def heteroscedasticity(innovations: np.ndarray) -> WhitenessTest:
    """Whether the last third of a series has another variance than the first ("breakvar"), two-sided.

    H = Σ e_t² of the last h / Σ e_t² of the first h,  h = T / 3;  (n_first / n_last) H is F(n_last, n_first),

    n_first and n_last being the values that are there; about zero, not about their mean.

    Args:
        innovations: Standardised innovations, (T,); NaN is a missing one.

    Source: Harvey, Forecasting, Structural Time Series Models and the Kalman Filter (1989), 5.4.2.
    """
    third = round(len(innovations) / 3)
    first, last = innovations[:third], innovations[len(innovations) - third :]
    n_first, n_last = int(np.isfinite(first).sum()), int(np.isfinite(last).sum())
    before = float(np.nansum(first**2))
    if min(n_first, n_last) < 2 or not before > 0.0:
        return WhitenessTest(np.nan, np.nan, (n_last, n_first))
    statistic = float(np.nansum(last**2)) / before
    ratio = statistic * n_first / n_last
    tails = fdtr(n_last, n_first, ratio), fdtrc(n_last, n_first, ratio)
    return WhitenessTest(statistic, 2.0 * float(min(tails)), (n_last, n_first))
