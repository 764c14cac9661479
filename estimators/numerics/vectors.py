"""The vector instructions of simd.py on arrays, so that no address stands in a filter.

Rows must be contiguous; n counts what of them is worked on.
"""

from __future__ import annotations

import math

from . import simd
from .jit import inlined
from .simd import WIDE
from .simd_ir import LANES


@inlined
def add_scaled(n, a, x, y):
    """y[:n] += a x[:n]."""
    simd.add_scaled(n, a, x.ctypes.data, y.ctypes.data)


@inlined
def scaled(n, a, x, out):
    """out[:n] = a[0] x[:n]."""
    simd.combine(1, a.ctypes.data, 1, x.ctypes.data, n, n, out.ctypes.data)


@inlined
def dot(n, a, b):
    """Σ a[:n] b[:n]."""
    return simd.dot(n, a.ctypes.data, b.ctypes.data)


@inlined
def total(n, x):
    """Σ x[:n]."""
    return simd.total(n, x.ctypes.data)


@inlined
def weighted(n, w, x, out):
    """out[:n] = w[:n] x[:n]; returns Σ out[:n]."""
    return simd.weighted(n, w.ctypes.data, x.ctypes.data, out.ctypes.data)


@inlined
def exp_minus(n, x, shift, out):
    """out[:n] = e^(x[:n] - shift); 0 where it is below the normal numbers."""
    simd.exp_minus(n, x.ctypes.data, shift, out.ctypes.data)


@inlined
def all_finite(n, X):
    """Whether the first n numbers of a matrix are finite: one sum says so, but for sums beyond the numbers."""
    return abs(simd.total(n, X.ctypes.data)) < math.inf


@inlined
def combine_rows(weights, count, rows, out):
    """out = Σ_k weights[k] rows[k], k < count, over the columns of `rows`, which are `WIDE` or `LANES`."""
    if rows.shape[1] == WIDE:
        simd.combine_wide(weights.ctypes.data, count, rows.ctypes.data, WIDE, out.ctypes.data)
    else:
        simd.combine_narrow(weights.ctypes.data, count, rows.ctypes.data, LANES, out.ctypes.data)


@inlined
def spread_rows(weights, count, x, rows):
    """rows[k] += weights[k] x, k < count, over the columns of `rows`, which are `WIDE` or `LANES`."""
    if rows.shape[1] == WIDE:
        simd.spread_wide(weights.ctypes.data, count, x.ctypes.data, rows.ctypes.data, WIDE)
    else:
        simd.spread_narrow(weights.ctypes.data, count, x.ctypes.data, rows.ctypes.data, LANES)
