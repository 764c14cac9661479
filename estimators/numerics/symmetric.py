"""Symmetric matrices of dozens to hundreds of rows, without LAPACK: the same bits on any number of threads.

Every inner loop runs along a row, on vector instructions. Eigenvalues come from a Householder reduction to a
tridiagonal matrix and the implicit QL iteration; eigenvectors are rows.

Sources: Golub & Van Loan, Matrix Computations, 4th ed., algorithms 8.3.1 and 8.3.3; Dubrulle, Martin & Wilkinson
(1968), The implicit QL algorithm, doi:10.1007/BF02165404.
"""

from __future__ import annotations

import numpy as np

from .jit import jit
from .simd import add_outer, add_scaled, combine, combine_four, dot, rotate, subtract_four, subtract_one
from .simd_ir import LANES
from .simd_lanes import NOTHING

_SWEEPS = 60
"""Iterations for one eigenvalue; two are usual, so this many mean that a number is not finite."""

_PANEL = 32
"""Rows of a panel of the Cholesky factor."""


@jit
def gram(Z, count, n, G):
    """G = Zᵀ Z for the leading `count` rows and n columns of Z, both triangles."""
    numbers, apart, width = Z[0], Z.shape[1], G.shape[1]
    fours = n // 4 * 4
    for k in range(0, fours, 4):
        # From the vector on that holds the diagonal; what is left of it is copied.
        first = k // LANES * LANES
        combine_four(count, numbers[k:], apart, numbers[first:], apart, n - first, G[k, first:], width)
    for k in range(fours, n):
        first = k // LANES * LANES
        combine(count, numbers[k:], apart, numbers[first:], apart, n - first, G[k, first:], width)
    for k in range(LANES, n):
        for j in range(k // LANES * LANES):
            G[k, j] = G[j, k]


@jit
def factor(A, n, U):
    """Upper U with Uᵀ U = I + A for the leading n rows of symmetric A; False if I + A is not positive definite.

    Rows below a panel of rows are read and written once per panel.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., algorithms 4.2.2 (outer product form) and 4.2.4 (blocks).
    """
    width = U.shape[1]
    for k in range(n):
        for j in range(n):
            U[k, j] = A[k, j] if j >= k else 0.0
        U[k, k] += 1.0
    for first in range(0, n, _PANEL):
        last = min(first + _PANEL, n)
        for k in range(first, last):
            pivot = U[k, k]
            if not (pivot > 0.0 and pivot < np.inf):
                return False
            scale = 1.0 / np.sqrt(pivot)
            for j in range(k, n):
                U[k, j] *= scale
            for i in range(k + 1, last):
                add_scaled(n - i, -U[k, i], U[k, i:], U[i, i:])
        fours = last + (n - last) // 4 * 4
        for i in range(last, fours, 4):
            subtract_four(last - first, U[first, i:], width, U[first, i:], width, n - i, U[i, i:], width)
            for k in range(1, 4):
                for j in range(k):
                    U[i + k, i + j] = 0.0
        for i in range(fours, n):
            subtract_one(last - first, U[first, i:], width, U[first, i:], width, n - i, U[i, i:], width)
    return True


@jit
def solve_rows(U, n, B, columns):
    """B ← (Uᵀ U)⁻¹ B for the leading n rows and `columns` columns of B."""
    for i in range(n):
        for j in range(columns):
            B[i, j] /= U[i, i]
        for k in range(i + 1, n):
            add_scaled(columns, -U[i, k], B[i], B[k])
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            add_scaled(columns, -U[i, k], B[k], B[i])
        for j in range(columns):
            B[i, j] /= U[i, i]


@jit
def symmetric_eigen(A, n, values, V, scratch):
    """Find the eigenvalues and eigenvectors of the leading n rows and columns of symmetric A, which is destroyed.

    Args:
        A: Symmetric, at least (n, n), rows contiguous.
        n: Order.
        values: Gets the eigenvalues (n,), in no particular order.
        V: Gets the eigenvectors as rows, (n, n): A = Vᵀ diag(values) V.
        scratch: At least 3 n numbers.

    Returns:
        False if it does not converge, which only a number that is not finite can cause.
    """
    halves = scratch[2 * n : 3 * n]
    tridiagonal(A, n, values, halves, scratch)
    V[:n, :n] = 0.0
    for i in range(n):
        V[i, i] = 1.0
    # Applied from the first reflection on, the rows of V become those of H.
    w = scratch[n : 2 * n]
    for k in range(n - 2):
        if halves[k] == 0.0:
            continue
        w[:] = 0.0
        for j in range(k + 1, n):
            add_scaled(n, A[k, j], V[j], w)
        for j in range(k + 1, n):
            add_scaled(n, -A[k, j] / halves[k], w, V[j])
    return _ql(n, values, scratch, V)


@jit
def tridiagonal(A, n, d, halves, scratch):
    """Reduce the leading n rows and columns of symmetric A to a tridiagonal T = H A Hᵀ.

    H = … H₁ H₀ with Hₖ = I - v vᵀ / halves[k]; where halves[k] is 0, Hₖ = I.

    Args:
        A: Symmetric, at least (n, n), rows contiguous; gets v in A[k, k+1:], and zeros before it from the place where
            a vector begins, so that whole vectors can be worked on.
        n: Order.
        d: Gets the diagonal of T (n,).
        halves: Gets vᵀ v / 2, (n,).
        scratch: At least 2 n numbers; gets T[k, k-1] in scratch[k].
    """
    e = scratch[:n]
    w = scratch[n : 2 * n]
    e[0] = 0.0
    for k in range(n - 2):
        d[k] = A[k, k]
        first = begin(k)
        size = n - first
        A[k, first : k + 1] = 0.0
        row, v = A[k, first:], A[k, k + 1 :]
        head = A[k, k + 1]
        A[k, k + 1] = 0.0
        tail = dot(size, row, row)
        if tail < NOTHING:
            e[k + 1] = head
            halves[k] = 0.0
            continue
        # The reflection I - 2 v vᵀ / (vᵀ v) that turns A[k, k+1:] into a multiple of e₁.
        length = np.sqrt(head * head + tail)
        if head > 0.0:
            length = -length
        e[k + 1] = length
        # vᵀ v / 2 after the change of v₀.
        half = length * (length - head)
        halves[k] = half
        A[k, k + 1] = head - length
        # A ← A - (v qᵀ + q vᵀ) / half with q = w - (vᵀ w / (2 half)) v, w = A v. Before column k + 1 the same sums
        # apply the reflection from one side, to what is not looked at again.
        below, rows = A[k + 1, first:], n - k - 1
        combine(rows, v, 1, below, A.shape[1], size, w, 0)
        add_scaled(size, -dot(size, row, w) / (2.0 * half), row, w)
        add_outer(rows, size, -1.0 / half, v, w, w[k + 1 - first :], row, below, A.shape[1])
    for k in range(max(n - 2, 0), n):
        d[k] = A[k, k]
    if n > 1:
        e[n - 1] = A[n - 2, n - 1]


@jit
def begin(k):
    """Where the vector begins that holds column k + 1."""
    return (k + 1) // LANES * LANES


@jit
def _ql(n, d, e, V):
    """Diagonalise T (diagonal d, below it e[1:]) by implicit shifts, and turn the rows of V along.

    Returns:
        False if it does not converge.
    """
    columns = V.shape[1]
    for k in range(1, n):
        e[k - 1] = e[k]
    e[n - 1] = 0.0
    for low in range(n):
        for sweep in range(_SWEEPS + 1):
            high = low
            while high < n - 1:
                size = abs(d[high]) + abs(d[high + 1])
                if not abs(e[high]) > 2.3e-16 * size:
                    break
                high += 1
            if high == low:
                break
            if sweep == _SWEEPS:
                return False
            g = (d[low + 1] - d[low]) / (2.0 * e[low])
            r = np.hypot(g, 1.0)
            g = d[high] - d[low] + e[low] / (g + (r if g >= 0.0 else -r))
            s = 1.0
            c = 1.0
            p = 0.0
            early = False
            for i in range(high - 1, low - 1, -1):
                f = s * e[i]
                b = c * e[i]
                r = np.sqrt(f * f + g * g)
                e[i + 1] = r
                if r == 0.0:
                    d[i + 1] -= p
                    e[high] = 0.0
                    early = True
                    break
                s = f / r
                c = g / r
                g = d[i + 1] - p
                r = (d[i] - g) * s + 2.0 * c * b
                p = s * r
                d[i + 1] = g + p
                g = c * r - b
                rotate(columns, c, s, V[i], V[i + 1])
            if early:
                continue
            d[low] -= p
            e[low] = g
            e[high] = 0.0
    for k in range(n):
        if not np.isfinite(d[k]):
            return False
    return True
