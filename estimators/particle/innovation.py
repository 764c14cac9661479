"""What a cloud expects of a reading: the innovation of its weighted mean, and the covariance of that."""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_rows, expect, sensor_variances
from ..compiled.sensor_noise import add_covariances
from ..numerics.jit import jit
from ..numerics.linalg import wrap


@jit
def first_residual(context, u, sensor, y, x, out):
    """What a reading leaves over the expectation of a particle x, by row, and 0 where it is no number.

    The residuals' moments are taken about that of the first particle: the spread of the particles then keeps its digits
    however far off the reading is.
    """
    expect(context, sensor, x, u, out)
    circular = circular_rows(context, sensor)
    for row in range(out.size):
        out[row] = y[row] - out[row]
        if circular[row] != 0:
            out[row] = wrap(out[row])
        if not np.isfinite(out[row]):
            out[row] = 0.0


@jit
def about(residual, reference, circular):
    """A residual's deviation from a reference; of angles the shorter way."""
    deviation = residual - reference
    return wrap(deviation) if circular != 0 else deviation


@jit
def finite_rows(y, rows):
    """How many of the reading's rows are there."""
    m = 0
    for row in range(rows):
        if np.isfinite(y[row]):
            m += 1
    return m


@jit
def predicted(context, u, sensor, y, x, shared, innovation, innovation_std):
    """Innovation ν and its covariance S, over the finite rows, from sums about the residual of x, the first particle.

    Returns:
        The number of finite rows.
    """
    sums, S, nu = shared.sums, shared.S, shared.nu
    r = sensor_variances(context, sensor)
    circular = circular_rows(context, sensor)
    m = finite_rows(y, r.size)
    first_residual(context, u, sensor, y, x, innovation[: r.size])
    k = 0
    for row in range(r.size):
        if not np.isfinite(y[row]):
            innovation[row] = np.nan
            continue
        nu[k] = sums[4 + k] / sums[0]
        for j in range(k + 1):
            S[k, j] = sums[4 + m + k * m + j] / sums[0] - nu[k] * nu[j]
            S[j, k] = S[k, j]
        S[k, k] = max(S[k, k], 0.0) + r[row]
        innovation[row] += nu[k]
        if circular[row] != 0:
            innovation[row] = wrap(innovation[row])
        innovation_std[row] = np.sqrt(S[k, k])
        k += 1
    add_covariances(context, sensor, y, 1.0, S)
    k = 0
    for row in range(r.size):
        if np.isfinite(y[row]):
            nu[k] = innovation[row]
            k += 1
    return m
