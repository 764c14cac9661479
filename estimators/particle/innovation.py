"""What a cloud expects of a reading: the innovation of its weighted mean, and the covariance of that."""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_rows, expect, has_own_likelihood, sensor_variances
from ..compiled.noise import add_covariances
from ..numerics.jit import jit
from ..numerics.linalg import wrap
from ..numerics.normal_score import normal_score
from ..track import WHITENED
from .moments import tails_of


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


@jit
def score_rows(context, sensor, y, shared, score):
    """Write the normal score of each finite row to score[WHITENED + row]: e = Φ⁻¹(F(y)), N(0, 1) under the model.

    F = Σ wᵢ Φ((y - hᵢ) / √sᵢ) is the distribution function of the row by itself under the weights before the reading,
    with sᵢ the variance of the reading given particle i: r, or H P Hᵀ + r where a Gaussian stands behind it. Angles
    are counted from what the first particle expects, up to half a turn to either side. A sensor with a likelihood of
    its own has no known distribution function, and its rows are NaN.
    """
    tails = tails_of(context, shared.sums)
    own = has_own_likelihood(context, sensor)
    k = 0
    for row in range(sensor_variances(context, sensor).size):
        score[WHITENED + row] = np.nan
        if np.isfinite(y[row]):
            if not own:
                score[WHITENED + row] = normal_score(tails[2 * k], tails[2 * k + 1])
            k += 1
