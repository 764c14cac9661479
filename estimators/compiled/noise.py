"""Noise as compiled filters use it: draws of process noise, and independent rows of a sensor.

Members draw w = L z with L Lᵀ = Q and z ~ N(0, I).

A sensor's full R is factored as R = L D Lᵀ. Multiplying the innovation, its Jacobian and its covariances by L⁻¹ leaves
rows whose noise is independent, with variances d, so that code for one variance per row handles a full R. As det L = 1,
NIS and likelihood do not change, and no variance is divided by, so one may be zero.

Source: Bierman (1977), Factorization Methods for Discrete Sequential Estimation, chapter IV (whitening observations).
"""

from __future__ import annotations

import numpy as np

from ..numerics.jit import floats, ints, jit, part
from ..numerics.linalg import unit_factor
from ..numerics.symmetric import symmetric_eigen
from .context import call_Q, parameters, prior, process_variances, sensor_rows, sensor_variances

_SMALL = 1e-13
"""A pivot below this part of its diagonal is rounding: its direction has no noise of its own."""


@jit
def semidefinite_root(A, L):
    """Factor a positive semidefinite A (n, n) = L Lᵀ with lower L; return False (and L of NaN) if A is not.

    Cholesky by columns; a pivot of zero leaves its column zero. Reads the lower triangle of A.

    Source: Higham (2002), Accuracy and Stability of Numerical Algorithms, 2nd edition, 10.3.
    """
    n = A.shape[0]
    L[:] = 0.0
    for j in range(n):
        pivot = A[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        # Written so that NaN fails too.
        if not pivot >= -1e-8 * abs(A[j, j]):
            L[:] = np.nan  # so that the failure shows in every result
            return False
        root = np.sqrt(pivot) if pivot > _SMALL * n * A[j, j] else 0.0
        L[j, j] = root
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if root > 0.0:
                L[i, j] = s / root
            # No variance left in j, so no covariance either. Roots apart: a product of tiny variances would underflow.
            elif not abs(s) <= 1e-6 * np.sqrt(A[i, i]) * np.sqrt(A[j, j]):
                L[:] = np.nan
                return False
    return True


@jit
def belief_root(P, L):
    """Factor a covariance P = L Lᵀ with lower L, or its diagonal if rounding left P indefinite."""
    if not semidefinite_root(P, L):
        for i in range(L.shape[0]):
            for j in range(L.shape[1]):
                L[i, j] = np.sqrt(max(P[i, i], 0.0)) if i == j else 0.0


@jit
def lost_root(context, first, P, root):
    """Fill a root L (k, k) of C - P: prior covariance C of the states from `first` on, less their covariance P (k, k).

    Chance makes P larger than C in some directions; L has no columns there. Returns False if P is not finite.
    """
    _, C = prior(context)
    count = root.shape[0]
    A, V, values = np.empty((count, count)), np.empty((count, count)), np.empty(count)
    for i in range(count):
        for j in range(count):
            # In units of the prior's deviations, so that none of them drowns in rounding errors of another.
            scale = np.sqrt(C[first + i, first + i] * C[first + j, first + j])
            A[i, j] = (C[first + i, first + j] - P[i, j]) / scale
    if not symmetric_eigen(A, count, values, V, np.empty(3 * count)):
        return False
    for k in range(count):
        length = np.sqrt(max(values[k], 0.0))
        for i in range(count):
            root[i, k] = length * V[k, i] * np.sqrt(C[first + i, first + i])
    return True


@jit
def noise_root(context, x, u, dt, L, scratch):
    """Fill L (nx, nx), lower, with L Lᵀ = Q(x, u, p, q, dt), or √(q·dt) on the diagonal where the model gives no Q.

    Where `context.Q_varies` is 0, the result does not depend on x, and one call serves all members of a step.
    """
    if context.Q == 0:
        L[:] = 0.0
        q = process_variances(context)
        state = ints(context.noise_state, context.n_noises)
        for k in range(q.size):
            L[state[k], state[k]] = np.sqrt(q[k] * dt)
        return
    scratch[:] = 0.0
    call_Q(context.Q, x, u, parameters(context), process_variances(context), dt, scratch)
    semidefinite_root(scratch, L)


@jit
def add_noise(L, z, x):
    """x += L z, with lower L."""
    for i in range(x.size):
        s = 0.0
        for j in range(i + 1):
            s += L[i, j] * z[j]
        x[i] += s


@jit
def has_correlated_rows(context, sensor):
    """Return whether the noise of a sensor's rows is correlated; otherwise R is diagonal."""
    return ints(context.correlation, context.n_sensors)[sensor] != 0


@part
def sensor_correlation(context, sensor):
    """Return c (ny * ny,), row by row, of a sensor with correlated rows: R_ij = c_ij √(r_i r_j)."""
    _, ny = sensor_rows(context, sensor)
    return floats(ints(context.correlation, context.n_sensors)[sensor], ny * ny)


@jit
def independent_rows(context, sensor, y, r, L, d):
    """Factor R over the finite rows of a measurement y (ny,): R = L diag(d) Lᵀ, with unit lower L.

    Args:
        context: The context.
        sensor: Index of the sensor.
        y: The measurement (ny,); missing rows are NaN, and the sub-block of R without them is factored.
        r: Variances of the sensor's rows in use (ny,).
        L: Gets the factor in the strictly lower triangle of its leading (m, m) (see `solve_unit`); unchanged if the
            rows are independent.
        d: Gets the variances of the independent rows (m,).

    Returns:
        The number m of finite rows.
    """
    ny = r.size
    m = np.int64(0)  # a literal would be a second type, and compile `unit_factor` twice
    for i in range(ny):
        if np.isfinite(y[i]):
            d[m] = r[i]
            m += 1
    if not has_correlated_rows(context, sensor):
        return m
    c = sensor_correlation(context, sensor)
    row = 0
    for i in range(ny):
        if np.isfinite(y[i]):
            column = 0
            for j in range(i):
                if np.isfinite(y[j]):
                    # The roots apart: the product of two tiny variances would underflow.
                    L[row, column] = c[i * ny + j] * np.sqrt(r[i]) * np.sqrt(r[j])
                    column += 1
            row += 1
    unit_factor(L, d, m)
    return m


@jit
def add_covariances(context, sensor, y, factor, S):
    """Add `factor` times the off-diagonal entries of R over the finite rows of y to S (m, m)."""
    if not has_correlated_rows(context, sensor):
        return
    r, c = sensor_variances(context, sensor), sensor_correlation(context, sensor)
    row = 0
    for i in range(r.size):
        if np.isfinite(y[i]):
            column = 0
            for j in range(i):
                if np.isfinite(y[j]):
                    covariance = factor * c[i * r.size + j] * np.sqrt(r[i]) * np.sqrt(r[j])
                    S[row, column] += covariance
                    S[column, row] += covariance
                    column += 1
            row += 1
