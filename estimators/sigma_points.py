"""Sigma points and what becomes of them: rows of 2n + 1 points, as wide as whole vectors.

What stands behind a row's own numbers is never read.
"""

from __future__ import annotations

import numpy as np

from .jit import inlined, jit
from .linalg import wrap
from .simd import LANES, centre, product


@jit
def padded(k):
    """How wide a row of k numbers is."""
    return (k + LANES - 1) // LANES * LANES


@inlined
def spread_points(x, U, spread, points):
    """Fill `points` (2n+1, padded n) with x and x ± spread·U[k]."""
    n = x.size
    for j in range(n):
        points[0, j] = x[j]
    for k in range(n):
        for j in range(n):
            d = spread * U[k, j]
            points[1 + k, j] = x[j] + d
            points[1 + n + k, j] = x[j] - d


@inlined
def deviations(D, w, circular, mean):
    """Turn points D (2n+1, padded k) into deviations from their weighted mean (padded k,), from the central point on.

    The weights sum to 1, so mean = D₀ + w Σ (Dᵢ - D₀): small alpha then costs no digits, and angles do not tear.
    """
    for j in range(circular.size):
        if circular[j] != 0:
            for i in range(1, D.shape[0]):
                d = D[i, j] - D[0, j]
                if abs(d) > np.pi:
                    D[i, j] = D[0, j] + wrap(d)
    centre(D.shape[0], circular.size, D.shape[1], D.ctypes.data, w, mean.ctypes.data)


@inlined
def covariance(D, first, w, P):
    """P (k, padded k) = first D₀ᵀ D₀ + w Σ Dᵢᵀ Dᵢ."""
    rows, width = D.shape
    product(P.shape[0], rows, D.ctypes.data, width, D.ctypes.data, width, first, w, P.ctypes.data)


@inlined
def cross_covariance(U, across, w, C):
    """C (n, padded m) = w Σ U[k]ᵀ across[k], with the differences `across` (n, padded m) between opposite points."""
    n, width = C.shape
    product(n, n, U.ctypes.data, n, across.ctypes.data, width, w, w, C.ctypes.data)
