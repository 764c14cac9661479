"""The innovation of a cloud's weighted mean with its covariance, normal scores, and the density of a measurement."""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_rows, expect, has_own_likelihood, own_likelihood, sensor_variances
from ..compiled.noise import add_covariances, has_correlated_rows
from ..compiled.verdict import LOG_2PI
from ..gaussian.shared import admit
from ..numerics.jit import jit
from ..numerics.linalg import solve_unit, wrap
from ..numerics.normal_score import add_tail, normal_score
from ..track import WHITENED
from .cloud import SETTLED, next_draw, own_cloud, tails_of
from .weights import NO_KEY, add_up, sweep, work_of


@jit
def first_residual(context, u, sensor, y, x, out):
    """Fill the residuals of particle x (ny,), 0 where a residual is not finite.

    The residuals' moments are taken about those of the first particle: the spread of the particles then keeps its
    digits however large the residuals are.
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
    """Return a residual's deviation from a reference, wrapped for angles."""
    deviation = residual - reference
    return wrap(deviation) if circular != 0 else deviation


@jit
def finite_rows(y, rows):
    """Return the number of finite rows."""
    m = 0
    for row in range(rows):
        if np.isfinite(y[row]):
            m += 1
    return m


@jit
def add_gaussian(context, sensor, y, w, reference, e, S, sums):
    """Add a particle's N(e, S) of the residual over the finite rows to the sums, with weight w, and its two tails.

    e becomes the deviation from the reference, S the covariance without R.
    """
    r = sensor_variances(context, sensor)
    circular = circular_rows(context, sensor)
    tails = tails_of(context, sums)
    sums[0] += w
    m = 0
    for row in range(r.size):
        if np.isfinite(y[row]):
            e[m] = about(e[m], reference[row], circular[row])
            if not has_own_likelihood(context, sensor):
                add_tail((reference[row] + e[m]) / np.sqrt(S[m, m]), w, tails[2 * m :])
            S[m, m] -= r[row]
            m += 1
    add_covariances(context, sensor, y, -1.0, S)
    for a in range(m):
        sums[4 + a] += w * e[a]
        for b in range(a + 1):
            sums[4 + m + a * m + b] += w * (e[a] * e[b] + S[a, b])


@jit
def expected_reading(phase, context, u, sensor, y, state, work, innovation, innovation_std, score):
    """Run the phase of the joint weights and the residuals' moments; fill the innovation and the scores.

    Returns:
        The index of the filter's draws, and the verdict of the gate.
    """
    shared, x = work_of(context, work), own_cloud(context, state).records[0, : context.nx]
    settled = state[SETTLED]
    index = next_draw(state)
    sweep(phase, context, u, 0.0, sensor, y, NO_KEY, 0.0, state, work)
    add_up(context, work)
    m = predicted(context, u, sensor, y, x, shared, innovation, innovation_std)
    state[SETTLED] = settled
    verdict = admit(context, sensor, m, shared.nu, shared.S, shared.U, score)
    score_rows(context, sensor, y, shared, score)
    return index, verdict


@jit
def predicted(context, u, sensor, y, x, shared, innovation, innovation_std):
    """Fill the innovation ν and its covariance S over the finite rows, from sums about the residual of particle x.

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

    F = Σ wᵢ Φ((y - hᵢ) / √sᵢ) is the distribution function of the row by itself under the weights before the
    measurement, with sᵢ the variance of the measurement given particle i: r, or H P Hᵀ + r where a Gaussian stands
    behind it. Angles count from the first particle's expectation, up to half a turn to either side. A sensor with a
    likelihood of its own has no known distribution function, and its rows are NaN.
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


@jit
def half_square(F, d, m, e):
    """Return ½ eᵀ R⁻¹ e of a residual e (m,) with R = F diag(d) Fᵀ; e becomes F⁻¹ e."""
    solve_unit(F, m, e)
    half = 0.0
    for k in range(m):
        half += 0.5 * e[k] * e[k] / d[k]
    return half


@jit
def log_density(context, sensor, u, y, x, F, d, e):
    """Return log p(y | x): Gaussian over the finite rows, or the sensor's own; -inf if it is NaN.

    F and d are those of `independent_rows`, e (ny,) is scratch.
    """
    if has_own_likelihood(context, sensor):
        value = own_likelihood(context, sensor, y, x, u)
    else:
        circular = circular_rows(context, sensor)
        expect(context, sensor, x, u, e)
        m = 0
        for row in range(circular.size):
            if np.isfinite(y[row]):
                # Row `row` moves up to m ≤ row.
                e[m] = y[row] - e[row]
                if circular[row] != 0:
                    e[m] = wrap(e[m])
                m += 1
        if has_correlated_rows(context, sensor):
            solve_unit(F, m, e)
        value = 0.0
        for k in range(m):
            value -= 0.5 * (e[k] * e[k] / d[k] + LOG_2PI + np.log(d[k]))
    return value if -np.inf < value < np.inf else -np.inf
