"""R of a sensor as a compiled filter uses it: rows made independent, R = L D Lᵀ.

Multiplying a reading's innovation, its Jacobian and its covariances by L⁻¹ leaves rows whose noise is independent, with
variances d: whatever handles a variance for each row then handles a full R. As det L = 1, NIS and likelihood stay what
they are, and no variance is divided by, so one may be zero.

Source: Bierman (1977), Factorization Methods for Discrete Sequential Estimation, chapter IV (whitening observations).
"""

from __future__ import annotations

import numpy as np

from ..numerics.jit import floats, ints, jit, part
from ..numerics.linalg import unit_factor
from .context import sensor_rows, sensor_variances


@jit
def has_correlated_rows(context, sensor):
    """Whether the noise of a sensor's rows is correlated; if not, R is the diagonal of their variances."""
    return ints(context.correlation, context.n_sensors)[sensor] != 0


@part
def sensor_correlation(context, sensor):
    """c (ny * ny,), by rows, of a sensor with correlated rows: R_ij = c_ij √(r_i r_j)."""
    _, ny = sensor_rows(context, sensor)
    return floats(ints(context.correlation, context.n_sensors)[sensor], ny * ny)


@jit
def independent_rows(context, sensor, y, r, L, d):
    """Factor R over the rows of a reading y (ny,) that are there: R = L diag(d) Lᵀ, with unit lower L.

    Args:
        context: The context.
        sensor: Index of the sensor.
        y: The reading (ny,); missing rows are NaN, and the sub-block of R without them is factored.
        r: Variances of the sensor's rows (ny,), as they are in use.
        L: Gets the factor in its leading (m, m), of which the strictly lower triangle is written and meant (see
            `solve_unit`); left alone where the rows are independent anyway.
        d: Gets the variances of the independent rows (m,).

    Returns:
        The number m of rows that are there.
    """
    ny = r.size
    m = 0
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
    """Add `factor` times what is off the diagonal of R, over the rows of y that are there, to S (m, m)."""
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
