"""Correlated rows of a sensor: R_ij = c_ij √(r_i r_j).

The variances r are tuned while the twin runs; the correlation c is a property of the instrument and stays, so R remains
a covariance whatever the variances become.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Correlation = tuple[tuple[float, ...], ...]
"""A correlation matrix (ny, ny) by rows: what a frozen sensor can hold and compare."""

_LEAST = 1e-9
"""Smallest eigenvalue of a correlation; below it rows repeat each other, and rounding decides what they say."""


def as_correlation(matrix: Any) -> Correlation:
    """The rows of a matrix, or of anything that NumPy takes for one."""
    return tuple(tuple(float(c) for c in row) for row in np.atleast_2d(np.asarray(matrix, float)))


def correlation_of(R: Any) -> Correlation:
    """The correlation c_ij = R_ij / √(R_ii R_jj) of a covariance R (ny, ny), whose diagonal is the rows' variances."""
    R = np.asarray(R, float)
    std = np.sqrt(np.diag(R))
    c = R / np.outer(std, std)
    np.fill_diagonal(c, 1.0)
    return as_correlation(c)


def covariance_of(correlation: Correlation | None, r: np.ndarray) -> np.ndarray:
    """R (ny, ny) of rows with variances r (ny,); diagonal where they have no correlation."""
    if correlation is None:
        return np.diag(r)
    std = np.sqrt(r)
    R = np.array(correlation) * np.outer(std, std)
    np.fill_diagonal(R, r)
    return R


def flaw(correlation: Correlation, ny: int) -> str | None:
    """What is wrong with the correlation of ny rows, and what to do about it; None if nothing is."""
    if len(correlation) != ny or any(len(row) != ny for row in correlation):
        return (
            f"has {len(correlation)} rows of {', '.join(str(len(row)) for row in correlation)}; it must be {ny} × {ny}"
        )
    c = np.array(correlation)
    if not np.all(np.isfinite(c)) or np.any(np.diag(c) != 1.0):
        return "must be finite, with ones on its diagonal; of a covariance R give R_ij / √(R_ii R_jj)"
    if not np.array_equal(c, c.T):
        return "is not symmetric; fill both triangles alike"
    least = np.linalg.eigvalsh(c)[0]
    if not least > _LEAST:
        remedy = "leave out rows that repeat others" if least > -_LEAST else "lessen the correlations"
        return f"is not positive definite (smallest eigenvalue {least:.2g}); {remedy}"
    return None
