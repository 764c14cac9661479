"""Small dense linear algebra for the filters.

Matrices are row-major and a few dozen wide at most, where a call to LAPACK costs more than the arithmetic. Inner
loops run along rows and add a multiple of one row to another, which compiles to vector instructions without
reordering sums; so results are the same bits on every run.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .jit import embedded, inlined, jit, part
from .simd_ir import LANES
from .simd_rows import multiply_rows

EPSILON = float(np.finfo(float).eps)


@inlined
def _take_upper(A, U, n):
    """Fill the leading n rows of U with the upper triangle of A, which may be U."""
    for i in range(n):
        for j in range(i):
            U[i, j] = 0.0
        for j in range(i, n):
            U[i, j] = A[i, j]


@inlined
def cholesky(A, U, n):
    """Upper U with Uᵀ U = A for the leading n rows; False if A is not positive definite. A and U may be one.

    Reads the upper triangle of A only.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., algorithm 4.2.2 (outer product form).
    """
    _take_upper(A, U, n)
    for k in range(n):
        pivot = U[k, k]
        if not (pivot > 0.0 and pivot < np.inf):
            return False
        # The next pivot waits for a division only; the root is off its way.
        inverse = 1.0 / pivot
        for i in range(k + 1, n):
            a = U[k, i] * inverse
            for j in range(i, n):
                U[i, j] -= a * U[k, j]
        scale = 1.0 / np.sqrt(pivot)
        for j in range(k, n):
            U[k, j] *= scale
    return True


@part
def root(A, U, n):
    """Upper U with Uᵀ U = A for a positive semidefinite A, which may be singular; False if A is indefinite.

    A pivot within rounding of zero gives a row of zeros. A and U may be one; reads the upper triangle only.

    Source: Higham (2002), Accuracy and Stability of Numerical Algorithms, 2nd edition, 10.3.
    """
    _take_upper(A, U, n)
    for k in range(n):
        # What is left of the diagonal entry that the column's Σ U² made up.
        pivot = U[k, k]
        whole = pivot
        for i in range(k):
            whole += U[i, k] * U[i, k]
        floor = 16.0 * n * EPSILON * whole
        if not (pivot >= -floor and pivot < np.inf):
            return False
        if pivot <= floor:
            for j in range(k, n):
                U[k, j] = 0.0
            continue
        scale = 1.0 / np.sqrt(pivot)
        for j in range(k, n):
            U[k, j] *= scale
        for i in range(k + 1, n):
            a = U[k, i]
            if a != 0.0:
                for j in range(i, n):
                    U[i, j] -= a * U[k, j]
    return True


@part
def triangularise(A, w):
    """Overwrite A (rows ≥ columns) with the upper R of A = Q R, its diagonal ≥ 0; w is scratch of a row's length.

    So Rᵀ R = Aᵀ A without forming either: a sum of covariances whose factors are stacked keeps all its digits.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., algorithm 5.2.1 (Householder).
    """
    rows, columns = A.shape
    for k in range(columns):
        square = 0.0
        for i in range(k, rows):
            square += A[i, k] * A[i, k]
        if square > 0.0:
            norm = np.sqrt(square)
            alpha = -norm if A[k, k] > 0.0 else norm
            # The reflection I - β v vᵀ takes column k to (α, 0, …), with v = column - α e and β = 2 / vᵀv.
            v = A[k, k] - alpha
            beta = 1.0 / (square + norm * abs(A[k, k]))
            for j in range(k + 1, columns):
                w[j] = v * A[k, j]
            for i in range(k + 1, rows):
                a = A[i, k]
                if a != 0.0:
                    for j in range(k + 1, columns):
                        w[j] += a * A[i, j]
            for j in range(k + 1, columns):
                w[j] *= beta
                A[k, j] -= v * w[j]
            for i in range(k + 1, rows):
                a = A[i, k]
                if a != 0.0:
                    A[i, k] = 0.0
                    for j in range(k + 1, columns):
                        A[i, j] -= a * w[j]
            A[k, k] = alpha
        if A[k, k] < 0.0:
            for j in range(k, columns):
                A[k, j] = -A[k, j]


@part
def remove(R, n, v):
    """Overwrite upper R (leading n rows and columns) with the factor of RᵀR - v vᵀ; False if that is not positive.

    v (n,) is lost. Source: Golub & Van Loan, Matrix Computations, 4th ed., 6.5.4 (hyperbolic rotations, the new row
    first and the vector from it, which is the stable order).
    """
    for k in range(n):
        if v[k] == 0.0:
            continue
        left = (R[k, k] - v[k]) * (R[k, k] + v[k])
        # Within rounding of zero nothing is known of what is left.
        if not left > 4.0 * n * EPSILON * R[k, k] * R[k, k]:
            return False
        c = np.sqrt(left) / R[k, k]
        s = v[k] / R[k, k]
        R[k, k] = c * R[k, k]
        for j in range(k + 1, n):
            R[k, j] = (R[k, j] - s * v[j]) / c
            v[j] = c * v[j] - s * R[k, j]
    return True


@embedded
def solve_transposed(U, m, b):
    """Overwrite b (m,) with U⁻ᵀ b for the leading m rows of upper U (forward substitution)."""
    for i in range(m):
        b[i] /= U[i, i]
        for j in range(i + 1, m):
            b[j] -= U[i, j] * b[i]


@embedded
def solve_upper(U, m, b):
    """Overwrite b (m,) with U⁻¹ b for the leading m rows of upper U (back substitution)."""
    for i in range(m - 1, -1, -1):
        s = b[i]
        for j in range(i + 1, m):
            s -= U[i, j] * b[j]
        b[i] = s / U[i, i]


@part
def add_square(R, n, v):
    """Overwrite upper R (leading n rows and columns) with the factor of RᵀR + v vᵀ; v (n,) is lost.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., 6.5.3 (Givens rotations).
    """
    for k in range(n):
        if v[k] == 0.0:
            continue
        length = np.sqrt(R[k, k] * R[k, k] + v[k] * v[k])
        c = R[k, k] / length
        s = v[k] / length
        R[k, k] = length
        for j in range(k + 1, n):
            a = R[k, j]
            R[k, j] = c * a + s * v[j]
            v[j] = c * v[j] - s * a


@jit
def unit_factor(A, d, m):
    """Overwrite the strictly lower triangle of A (m, m) with that of unit lower L, and its diagonal d (m,) with D's.

    A = L diag(d) Lᵀ for a positive semidefinite A; a row without variance has no covariance, and a column of zeros.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., 4.1.3 (LDLᵀ, outer product form).
    """
    for k in range(m):
        inverse = 1.0 / d[k] if d[k] > 0.0 else 0.0
        for i in range(k + 1, m):
            a = A[i, k] * inverse
            for j in range(k + 1, i):
                A[i, j] -= a * A[j, k]
            d[i] -= a * A[i, k]
        for i in range(k + 1, m):
            A[i, k] *= inverse


@inlined
def solve_unit(L, m, b):
    """Overwrite b (m,) with L⁻¹ b for unit lower L (m, m), whose strictly lower triangle alone is read."""
    for i in range(1, m):
        for j in range(i):
            b[i] -= L[i, j] * b[j]


@part
def congruence(F, rows, P, T):
    """Overwrite symmetric P with F P Fᵀ, where F is the identity beyond its first `rows`; T (2n, n) is scratch.

    Beyond `rows` P stays, as do the covariances among what is there.
    """
    n = P.shape[0]
    if rows < n:
        multiply(F, rows, P, T)
        for i in range(rows):
            for j in range(i + 1):
                s = 0.0
                for k in range(n):
                    s += T[i, k] * F[j, k]
                P[i, j] = s
                P[j, i] = s
            for j in range(rows, n):
                P[i, j] = T[i, j]
                P[j, i] = T[i, j]
        return
    if n >= LANES:
        FP, PF = T[:n], T[n:]
        multiply_rows(F, n, n, P, 0, FP)
        for i in range(n):
            for j in range(n):
                PF[j, i] = FP[i, j]
        multiply_rows(F, n, n, PF, 1, P)
        mirror(P)
        return
    multiply(F, n, P, T)
    for i in range(n):
        for j in range(n):
            T[n + i, j] = F[j, i]
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = 0.0
        for k in range(n):
            a = T[i, k]
            if a != 0.0:
                for j in range(i + 1):
                    P[i, j] += a * T[n + k, j]
    mirror(P)


@inlined
def multiply(A, rows, B, out):
    """Leading rows of out = those of A B; few entries of A differ from zero."""
    for i in range(rows):
        for j in range(B.shape[1]):
            out[i, j] = 0.0
        for k in range(B.shape[0]):
            a = A[i, k]
            if a != 0.0:
                for j in range(B.shape[1]):
                    out[i, j] += a * B[k, j]


@embedded
def copy_vector(a, b):
    """b ← a, of which b may have more entries."""
    for i in range(a.size):
        b[i] = a[i]


@inlined
def copy(A, B):
    """B ← A, of which B may have more columns."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            B[i, j] = A[i, j]


@inlined
def multiply_transposed(A, B, out):
    """Fill out = A Bᵀ."""
    for i in range(A.shape[0]):
        for k in range(B.shape[0]):
            s = 0.0
            for j in range(A.shape[1]):
                s += A[i, j] * B[k, j]
            out[i, k] = s


@inlined
def mirror(P):
    """Copy the lower triangle of P onto the upper."""
    for i in range(P.shape[0]):
        for j in range(i):
            P[j, i] = P[i, j]


def wrapped(angle: np.ndarray, circular: ArrayLike = True) -> np.ndarray:
    """Return numbers of which those that are `circular` are brought to [-π, π)."""
    with np.errstate(invalid="ignore"):  # of numbers that are not finite
        return np.where(circular, (angle + np.pi) % (2.0 * np.pi) - np.pi, angle)


@jit
def wrap(angle):
    """An angle in radians brought to [-π, π)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
