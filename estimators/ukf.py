"""The unscented Kalman filter: 2n + 1 sigma points through the true f and h, no derivatives.

Sigma points x, x ± √(n+λ) U[i] with P = Uᵀ U and λ = α² (n + κ) - n; weights 1/(2(n+λ)), the central one λ/(n+λ) for
the mean and λ/(n+λ) + 1 - α² + β for the covariance.

Sources: Julier & Uhlmann (2004), doi:10.1109/JPROC.2003.823141; Wan & van der Merwe (2000),
doi:10.1109/ASSPCC.2000.882463.
"""

from __future__ import annotations

import numpy as np

from .context import (
    add_process_noise,
    circular_rows,
    circular_states,
    expect,
    options,
    sensor_rows,
    transition,
)
from .filter import Estimator, Option, Options
from .gaussian import compare, describe, downdate, judge, moments, move_mean, start, state_size, wrap_mean
from .jit import jit, matrix
from .linalg import cholesky, mirror, wrap
from .track import FAILED, USED

CENTRAL_COV, OUTER, SPREAD = range(3)
"""Positions in the context's options: the central covariance weight, the outer weight, √(n+λ)."""


def tune(values: Options, nx: int) -> np.ndarray:
    """The weights that alpha, beta and kappa give for nx states."""
    alpha, beta, kappa = values["alpha"], values["beta"], values["kappa"]
    total = alpha**2 * (nx + kappa)
    central = 1.0 - nx / total
    return np.array([central + 1.0 - alpha**2 + beta, 0.5 / total, np.sqrt(total)])


def points(values: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """The sigma points (2 nx + 1, nx) of a state."""
    x, P = moments(values, state, nx)
    try:
        U = np.linalg.cholesky(P).T * tune(values, nx)[SPREAD]
    except np.linalg.LinAlgError:
        return np.zeros((0, nx))
    return np.vstack((x, x + U, x - U))


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: the factor, deviations of state and reading, mean, point; and ŷ, S, its factor, C."""
    return nx * nx + (2 * nx + 1) * (nx + ny) + 2 * nx + ny + 2 * ny * ny + nx * ny + ny


@jit
def _mean_of(D, w, circular, mean):
    """Turn points D (2n+1, k) into deviations from their weighted mean, which is added up from the central point.

    The weights sum to 1, so mean = D₀ + w Σ (Dᵢ - D₀): small alpha then costs no digits, and angles do not tear.
    """
    k = mean.size
    for j in range(k):
        mean[j] = 0.0
    for i in range(1, D.shape[0]):
        for j in range(k):
            D[i, j] -= D[0, j]
            if circular[j] != 0:
                D[i, j] = wrap(D[i, j])
            mean[j] += D[i, j]
    for j in range(k):
        mean[j] *= w
        central = D[0, j]
        D[0, j] = 0.0
        for i in range(D.shape[0]):
            D[i, j] -= mean[j]
        mean[j] += central


@jit
def predict(context, u, dt, index, state, work):
    """x, P ← mean and covariance of the propagated sigma points, plus Q.

    Fails when P loses positive definiteness; the state then becomes NaN and the twin reports divergence.
    Source: Julier & Uhlmann (2004), section IV.
    """
    n = context.nx
    x = state[:n]
    P = matrix(state, n, n, n)
    U = matrix(work, 0, n, n)
    at = n * n
    D = matrix(work, at, 2 * n + 1, n)
    at += (2 * n + 1) * n
    point = work[at : at + n]
    forward = work[at + n : at + 2 * n]
    weights = options(context)
    w = weights[OUTER]
    spread = weights[SPREAD]
    if not cholesky(P, U, n):
        for i in range(state.size):
            state[i] = np.nan
        return
    transition(context, x, u, dt, D[0])
    for k in range(n):
        for j in range(n):
            point[j] = x[j] + spread * U[k, j]
        transition(context, point, u, dt, D[1 + k])
        for j in range(n):
            point[j] = x[j] - spread * U[k, j]
        transition(context, point, u, dt, D[1 + n + k])
    _mean_of(D, w, circular_states(context), forward)
    for i in range(n):
        a = weights[CENTRAL_COV] * D[0, i]
        for j in range(i + 1):
            P[i, j] = a * D[0, j]
    for k in range(1, 2 * n + 1):
        for i in range(n):
            a = w * D[k, i]
            for j in range(i + 1):
                P[i, j] += a * D[k, j]
    mirror(P)
    add_process_noise(context, x, u, dt, P, U)
    for i in range(n):
        x[i] = forward[i]
    wrap_mean(context, x)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """x ← x + C S⁻¹ ν;  P ← P - C S⁻¹ Cᵀ, with C and S from fresh sigma points through h.

    Source: Julier & Uhlmann (2004), section IV; sigma points are drawn anew from the prediction, so that they carry Q.
    """
    n = context.nx
    _, m = sensor_rows(context, sensor)
    x = state[:n]
    P = matrix(state, n, n, n)
    U = matrix(work, 0, n, n)
    at = n * n
    D = matrix(work, at, 2 * n + 1, m)
    at += (2 * n + 1) * m
    point = work[at : at + n]
    at += n
    nu = work[at : at + m]
    at += m
    S = matrix(work, at, m, m)
    at += m * m
    V = matrix(work, at, m, m)
    at += m * m
    C = matrix(work, at, n, m)
    weights = options(context)
    w = weights[OUTER]
    spread = weights[SPREAD]
    if not cholesky(P, U, n):
        return FAILED
    expect(context, sensor, x, u, D[0])
    for k in range(n):
        for j in range(n):
            point[j] = x[j] + spread * U[k, j]
        expect(context, sensor, point, u, D[1 + k])
        for j in range(n):
            point[j] = x[j] - spread * U[k, j]
        expect(context, sensor, point, u, D[1 + n + k])
    _mean_of(D, w, circular_rows(context, sensor), nu)
    for i in range(m):
        a = weights[CENTRAL_COV] * D[0, i]
        for j in range(m):
            S[i, j] = a * D[0, j]
    for k in range(1, 2 * n + 1):
        for i in range(m):
            a = w * D[k, i]
            for j in range(m):
                S[i, j] += a * D[k, j]
    # The sigma deviations of the state are ± spread·U[k], so C = w·spread Σ U[k] (D₊ₖ - D₋ₖ).
    scale = w * spread
    for i in range(n):
        for j in range(m):
            C[i, j] = 0.0
    for k in range(n):
        for i in range(k, n):
            a = scale * U[k, i]
            for j in range(m):
                C[i, j] += a * (D[1 + k, j] - D[1 + n + k, j])
    m = compare(context, sensor, y, nu, C, S, D[:, :0], innovation, innovation_std)
    verdict = judge(context, sensor, m, nu, S, V, score)
    if verdict == USED:
        move_mean(m, C, V, nu, x)
        wrap_mean(context, x)
        downdate(m, C, V, P)
    return verdict


UKF = Estimator(
    name="ukf",
    title="Unscented Kalman filter",
    family="Gaussian",
    assumes="f and h smooth within the spread; posterior well described by mean and covariance",
    model_runs="2 nx + 1",
    fails_when="P stops being positive definite, or the posterior has several peaks",
    source="Julier & Uhlmann (2004), doi:10.1109/JPROC.2003.823141",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: 2 * nx + 1,
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    points=points,
    options=(
        Option("alpha", 1.0, 1e-4, 2.0, "", "spread of the sigma points"),
        Option("beta", 2.0, 0.0, 10.0, "", "knowledge of the distribution; 2 is best for a Gaussian"),
        Option("kappa", 0.0, -0.9, 10.0, "", "second spread; nx + kappa must stay positive"),
    ),
    tune=tune,
)
