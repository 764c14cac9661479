"""Small dense linear algebra for the filters.

Matrices are row-major and a few dozen wide at most, where a call to LAPACK costs more than the arithmetic. Inner
loops run along rows and add a multiple of one row to another, which compiles to vector instructions without
reordering sums; so results are the same bits on every run.
"""

from __future__ import annotations

import numpy as np

from .jit import jit


@jit
def cholesky(A, U, n):
    """Upper U with Uᵀ U = A for the leading n rows; False if A is not positive definite. A and U may be one.

    Reads the upper triangle of A only.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., algorithm 4.2.2 (outer product form).
    """
    for i in range(n):
        for j in range(i):
            U[i, j] = 0.0
        for j in range(i, n):
            U[i, j] = A[i, j]
    for k in range(n):
        pivot = U[k, k]
        if not (pivot > 0.0 and pivot < np.inf):
            return False
        scale = 1.0 / np.sqrt(pivot)
        for j in range(k, n):
            U[k, j] *= scale
        for i in range(k + 1, n):
            a = U[k, i]
            for j in range(i, n):
                U[i, j] -= a * U[k, j]
    return True


@jit
def solve_transposed(U, m, b):
    """Overwrite b (m,) with U⁻ᵀ b for the leading m rows of upper U (forward substitution)."""
    for i in range(m):
        b[i] /= U[i, i]
        for j in range(i + 1, m):
            b[j] -= U[i, j] * b[i]


@jit
def solve_upper(U, m, b):
    """Overwrite b (m,) with U⁻¹ b for the leading m rows of upper U (back substitution)."""
    for i in range(m - 1, -1, -1):
        s = b[i]
        for j in range(i + 1, m):
            s -= U[i, j] * b[j]
        b[i] = s / U[i, i]


@jit
def congruence(F, P, T):
    """Overwrite symmetric P with F P Fᵀ; T is scratch of twice the shape (2n, n)."""
    n = P.shape[0]
    for i in range(n):
        for j in range(n):
            T[i, j] = 0.0
            T[n + i, j] = F[j, i]
        for k in range(n):
            a = F[i, k]
            if a != 0.0:
                for j in range(n):
                    T[i, j] += a * P[k, j]
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = 0.0
        for k in range(n):
            a = T[i, k]
            if a != 0.0:
                for j in range(i + 1):
                    P[i, j] += a * T[n + k, j]
    mirror(P)


@jit
def mirror(P):
    """Copy the lower triangle of P onto the upper."""
    for i in range(P.shape[0]):
        for j in range(i):
            P[j, i] = P[i, j]


@jit
def wrap(angle):
    """An angle in radians brought to [-π, π)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
