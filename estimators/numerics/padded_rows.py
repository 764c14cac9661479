"""Arrays whose rows are as wide as whole vectors, worked on by the vector instructions of simd_rows.py.

What stands after a row's own numbers is never read.
"""

from __future__ import annotations

from . import simd_rows
from .jit import inlined


@inlined
def factor(P, U):
    """Upper U (n, padded n) with Uᵀ U = P (n, n); False if P is not positive definite."""
    return simd_rows.factor_rows(P.shape[0], P.ctypes.data, U.ctypes.data, U.shape[1]) != 0


@inlined
def spread_points(x, U, spread, points):
    """Fill `points` (2n+1, padded n) with x and x ± spread·U[k]."""
    simd_rows.around(x.size, x.ctypes.data, U.ctypes.data, U.shape[1], spread, points.ctypes.data, points.shape[1])


@inlined
def centre(D, k, w, mean):
    """Turn points D (2n+1, padded k) into deviations from mean = D₀ + w Σ (Dᵢ - D₀), (padded k,)."""
    simd_rows.centre(D.shape[0], k, D.shape[1], D.ctypes.data, w, mean.ctypes.data)


@inlined
def covariance(D, first, w, P):
    """P (k, k) = first D₀ᵀ D₀ + w Σ Dᵢᵀ Dᵢ, from deviations D (2n+1, padded k)."""
    rows, width = D.shape
    k = P.shape[0]
    simd_rows.product(k, rows, D.ctypes.data, width, D.ctypes.data, width, first, w, P.ctypes.data, k)


@inlined
def cross_covariance(U, across, w, C):
    """C (n, m) = w Σ U[k]ᵀ across[k], with differences `across` (n, padded m) between opposite points."""
    n, m = C.shape
    simd_rows.product(n, n, U.ctypes.data, U.shape[1], across.ctypes.data, across.shape[1], w, w, C.ctypes.data, m)


@inlined
def subtract_squares(W, m, P):
    """P (n, n) -= Wᵀ W, of the leading m rows of W (m or more, padded n)."""
    simd_rows.subtract_squares(P.shape[0], m, W.ctypes.data, W.shape[1], P.ctypes.data)
