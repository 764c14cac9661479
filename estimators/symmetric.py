"""Symmetric matrices of dozens to hundreds of rows, without LAPACK: the same bits on any number of threads.

Every inner loop runs along a row, on vector instructions. Eigenvalues come from a Householder reduction to a
tridiagonal matrix and the implicit QL iteration; eigenvectors are rows.

Sources: Golub & Van Loan, Matrix Computations, 4th ed., algorithms 8.3.1 and 8.3.3; Dubrulle, Martin & Wilkinson
(1968), The implicit QL algorithm, doi:10.1007/BF02165404.
"""

from __future__ import annotations

import numpy as np

from .jit import jit, matrix
from .simd import add_both_scaled, add_scaled, combine, rotate

_SWEEPS = 60
"""Iterations for one eigenvalue; two are usual, so this many mean that a number is not finite."""


@jit
def gram(Z, count, n, G):
    """G = Zᵀ Z for the leading `count` rows and n columns of Z, both triangles."""
    rows, apart = Z.ctypes.data, Z.shape[1]
    for k in range(n):
        combine(count, rows + 8 * k, apart, rows, apart, n, G[k].ctypes.data)


@jit
def factor(A, n, U):
    """Upper U with Uᵀ U = I + A for the leading n rows of symmetric A; False if I + A is not positive definite.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., algorithm 4.2.2 (outer product form).
    """
    for k in range(n):
        for j in range(n):
            U[k, j] = A[k, j] if j >= k else 0.0
        U[k, k] += 1.0
    for k in range(n):
        pivot = U[k, k]
        if not (pivot > 0.0 and pivot < np.inf):
            return False
        scale = 1.0 / np.sqrt(pivot)
        for j in range(k, n):
            U[k, j] *= scale
        for i in range(k + 1, n):
            add_scaled(n - i, -U[k, i], U[k, i:].ctypes.data, U[i, i:].ctypes.data)
    return True


@jit
def solve_rows(U, n, B, columns):
    """B ← (Uᵀ U)⁻¹ B for the leading n rows and `columns` columns of B."""
    for i in range(n):
        for j in range(columns):
            B[i, j] /= U[i, i]
        for k in range(i + 1, n):
            add_scaled(columns, -U[i, k], B[i].ctypes.data, B[k].ctypes.data)
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            add_scaled(columns, -U[i, k], B[k].ctypes.data, B[i].ctypes.data)
        for j in range(columns):
            B[i, j] /= U[i, i]


@jit
def root_action(A, n, d, b, g, inverse_root, scratch):
    """b ← f(A) b for symmetric positive semidefinite A, without its eigenvectors: in half the time of finding them.

    The reduction to a diagonal matrix, A = Qᵀ Λ Q, is a product of reflections and rotations; they turn b and g as they
    are found, and are undone on f(Λ) Q b in the reverse order.

    Args:
        A: Symmetric (n, n), rows contiguous; is destroyed.
        n: Order.
        d: Gets the eigenvalues (n,).
        b: A vector (n,).
        g: Another; gets Q g.
        inverse_root: Whether f(λ) = 1/√(1+λ), or else f(λ) = 1 / (1 + λ + √(1+λ)).
        scratch: At least 5 n + 3 (2 n² + 8 n) numbers.

    Returns:
        bᵀ (I + A)⁻¹ g of the b given; NaN if a number is not finite.
    """
    half = scratch[2 * n : 3 * n]
    _tridiagonal(A, n, d, half, scratch)
    for k in range(n - 2):
        if half[k] != 0.0:
            _reflect(A[k, k + 1 : n], half[k], b[k + 1 : n])
            _reflect(A[k, k + 1 : n], half[k], g[k + 1 : n])
    pairs = matrix(scratch, 3 * n, n, 2)
    turns = scratch[5 * n : 5 * n + 3 * (2 * n * n + 8 * n)]
    for k in range(n):
        pairs[k, 0] = b[k]
        pairs[k, 1] = g[k]
    count = _ql(n, d, scratch, turns, pairs)
    if count < 0:
        return np.nan
    product = 0.0
    for k in range(n):
        grown = 1.0 + max(d[k], 0.0)
        b[k] = pairs[k, 0]
        g[k] = pairs[k, 1]
        product += b[k] * g[k] / grown
        b[k] /= np.sqrt(grown) if inverse_root else grown + np.sqrt(grown)
    for at in range(count - 3, -1, -3):
        c, s, i = turns[at], turns[at + 1], int(turns[at + 2])
        b[i], b[i + 1] = c * b[i] + s * b[i + 1], c * b[i + 1] - s * b[i]
    for k in range(n - 3, -1, -1):
        if half[k] != 0.0:
            _reflect(A[k, k + 1 : n], half[k], b[k + 1 : n])
    return product


@jit
def _reflect(v, half, x):
    """x ← (I - v vᵀ / half) x."""
    dot = 0.0
    for j in range(v.size):
        dot += v[j] * x[j]
    dot /= half
    for j in range(v.size):
        x[j] -= dot * v[j]


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
    _tridiagonal(A, n, values, halves, scratch)
    for i in range(n):
        for j in range(n):
            V[i, j] = 0.0
        V[i, i] = 1.0
    # Applied from the first reflection on, the rows of V become those of H.
    w = scratch[n : 2 * n]
    for k in range(n - 2):
        if halves[k] == 0.0:
            continue
        for j in range(n):
            w[j] = 0.0
        for j in range(k + 1, n):
            add_scaled(n, A[k, j], V[j].ctypes.data, w.ctypes.data)
        for j in range(k + 1, n):
            add_scaled(n, -A[k, j] / halves[k], w.ctypes.data, V[j].ctypes.data)
    return _ql(n, values, scratch, scratch[:0], V) >= 0


@jit
def _tridiagonal(A, n, d, halves, scratch):
    """Reduce A to a tridiagonal T: its diagonal goes to d, T[k, k-1] to scratch[k]; uses scratch[n : 2n].

    T = H A Hᵀ with H = … H₁ H₀ and Hₖ = I - v vᵀ / halves[k]; v stays in A[k, k+1:]. Where halves[k] is 0, Hₖ = I.
    """
    e = scratch[:n]
    w = scratch[n : 2 * n]
    to_w = w.ctypes.data
    e[0] = 0.0
    for k in range(n - 2):
        # The reflection I - 2 v vᵀ / (vᵀ v) that turns A[k, k+1:] into a multiple of e₁; v stays in that row.
        size = n - k - 1
        v = A[k, k + 1 : n]
        scale = 0.0
        for j in range(size):
            scale = max(scale, abs(v[j]))
        tail = 0.0
        for j in range(1, size):
            tail += abs(v[j])
        if tail == 0.0:
            e[k + 1] = v[0]
            halves[k] = 0.0
            continue
        norm = 0.0
        for j in range(size):
            v[j] /= scale
            norm += v[j] * v[j]
        length = np.sqrt(norm)
        if v[0] > 0.0:
            length = -length
        e[k + 1] = scale * length
        # vᵀ v / 2 after the change of v₀.
        half = norm - v[0] * length
        halves[k] = half
        v[0] -= length
        # A ← A - v qᵀ - q vᵀ with q = w - (vᵀ w / (2 half)) v, w = A v / half.
        combine(size, v.ctypes.data, 1, A[k + 1, k + 1 :].ctypes.data, A.shape[1], size, to_w)
        dot = 0.0
        for j in range(size):
            w[j] /= half
            dot += v[j] * w[j]
        dot /= 2.0 * half
        for j in range(size):
            w[j] -= dot * v[j]
        to_v = v.ctypes.data
        for j in range(size):
            add_both_scaled(size, -v[j], to_w, -w[j], to_v, A[k + 1 + j, k + 1 :].ctypes.data)
    if n > 1:
        e[n - 1] = A[n - 2, n - 1]
    for k in range(n):
        d[k] = A[k, k]


@jit
def _ql(n, d, e, turns, V):
    """Diagonalise T (diagonal d, below it e[1:]) by implicit shifts.

    The rows of V are turned along. The rotations are written to `turns` as c, s and row, unless it is empty.

    Returns:
        How many numbers were written; -1 if it does not converge.
    """
    written = 0
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
                return -1
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
                rotate(columns, c, s, V[i].ctypes.data, V[i + 1].ctypes.data)
                if turns.size > 0:
                    if written + 3 > turns.size:
                        return -1
                    turns[written] = c
                    turns[written + 1] = s
                    turns[written + 2] = i
                    written += 3
            if early:
                continue
            d[low] -= p
            e[low] = g
            e[high] = 0.0
    for k in range(n):
        if not np.isfinite(d[k]):
            return -1
    return written
