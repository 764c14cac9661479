"""Sigma points and what becomes of them: rows of 2n + 1 points, as wide as whole vectors.

What stands behind a row's own numbers is never read.
"""

from __future__ import annotations

import numpy as np

from ..numerics.jit import inlined
from ..numerics.linalg import wrap
from ..numerics.simd_rows import around, centre, factor_rows, product


@inlined
def factor(P, U):
    """Upper U (n, padded n) with Uᵀ U = P (n, n); False if P is not positive definite."""
    return factor_rows(P.shape[0], P.ctypes.data, U.ctypes.data, U.shape[1]) != 0


@inlined
def spread_points(x, U, spread, points):
    """Fill `points` (2n+1, padded n) with x and x ± spread·U[k]."""
    around(x.size, x.ctypes.data, U.ctypes.data, U.shape[1], spread, points.ctypes.data, points.shape[1])


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
    """P (k, k) = first D₀ᵀ D₀ + w Σ Dᵢᵀ Dᵢ, from deviations D (2n+1, padded k)."""
    rows, width = D.shape
    k = P.shape[0]
    product(k, rows, D.ctypes.data, width, D.ctypes.data, width, first, w, P.ctypes.data, k)


@inlined
def cross_covariance(U, across, w, C):
    """C (n, m) = w Σ U[k]ᵀ across[k], with differences `across` (n, padded m) between opposite points."""
    n, m = C.shape
    product(n, n, U.ctypes.data, U.shape[1], across.ctypes.data, across.shape[1], w, w, C.ctypes.data, m)
