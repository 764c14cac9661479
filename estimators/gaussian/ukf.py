"""The unscented Kalman filter: 2n + 1 sigma points through the true f and h, no derivatives.

Sigma points x, x ± √(n+λ) U[i] with P = Uᵀ U and λ = α² (n + κ) - n; weights 1/(2(n+λ)), the central one λ/(n+λ) for
the mean and λ/(n+λ) + 1 - α² + β for the covariance.

Sources: Julier & Uhlmann (2004), doi:10.1109/JPROC.2003.823141; Wan & van der Merwe (2000),
doi:10.1109/ASSPCC.2000.882463.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_rows, circular_states, expect_rows, options, sensor_rows, transition_rows
from ..estimator import Estimator, Option, Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import jit, matrix
from ..numerics.linalg import EPSILON
from ..numerics.simd_ir import padded
from ..track import FAILED, USED
from ..tuning import Tuning
from . import shared
from .robust import (
    ADAPT,
    NONE,
    OFF,
    OPTIONS,
    OWN,
    ROBUST,
    adapt,
    add_noise,
    memory,
    reading_variances,
    reweigh,
    shared_options,
)
from .shared import admit, compare, describe, downdate, moments, move_mean, start, state_size, wrap_mean
from .sigma_points import covariance, cross_covariance, deviations, factor, spread_points

CENTRAL_COV, OUTER, SPREAD = range(OWN, OWN + 3)
"""Positions in the context's options: the central covariance weight, the outer weight, √(n+λ)."""


def weights(alpha: float, beta: float, kappa: float, nx: int) -> list[float]:
    """Central covariance weight, outer weight and spread that alpha, beta and kappa give for nx states."""
    total = alpha**2 * (nx + kappa)
    central = 1.0 - nx / total
    return [central + 1.0 - alpha**2 + beta, 0.5 / total, float(np.sqrt(total))]


def tune(values: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The shared options, and the weights."""
    return np.array(shared_options(values) + weights(values["alpha"], values["beta"], values["kappa"], model.nx))


def refuses(model: StateSpaceModel, values: Options) -> str | None:
    """nx + kappa is what the spread is the root of; kappa = 3 - nx, of Julier & Uhlmann, leaves 3 of it."""
    kappa = values["kappa"]
    if model.nx + kappa > 0.0:
        return None
    return (
        f"kappa is {kappa:g}, and {model.name} has {model.nx} states; nx + kappa must be positive: give more than "
        f"{-model.nx}, as 3 - nx = {3 - model.nx}"
    )


def sigma_points(x: np.ndarray, P: np.ndarray, spread: float) -> np.ndarray:
    """The sigma points (2 nx + 1, nx) of a mean and covariance; none where the covariance has no factor."""
    try:
        U = np.linalg.cholesky(P).T * spread
    except np.linalg.LinAlgError:
        return np.zeros((0, x.size))
    return np.vstack((x, x + U, x - U))


def points(values: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """The sigma points (2 nx + 1, nx) of a state."""
    return sigma_points(*moments(values, state, nx), weights(values["alpha"], values["beta"], values["kappa"], nx)[2])


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: an update's; the factor, sigma points, the same through f or h, their mean and covariance."""
    n, m = padded(nx), padded(ny)
    return shared.scratch_size(nx, ny) + nx * n + (2 * nx + 1) * (n + max(n, m)) + max(n, m)


@jit
def predict(context, u, dt, index, state, work):
    """x, P ← mean and covariance of the propagated sigma points, plus Q.

    Fails when P loses positive definiteness; the state then becomes NaN and the twin reports divergence.
    Source: Julier & Uhlmann (2004), as above.
    """
    n = context.nx
    width = padded(n)
    x = state[:n]
    P = matrix(state, n, n, n)
    D = matrix(work, 0, 2 * n + 1, width)
    at = D.size
    sigma = matrix(work, at, 2 * n + 1, width)
    at += sigma.size
    forward = work[at : at + width]
    U = matrix(work, at + width, n, width)
    numbers = options(context)
    if not factor(P, U):
        for i in range(n + n * n):
            state[i] = np.nan
        return
    spread_points(x, U, numbers[SPREAD], sigma)
    transition_rows(context, sigma.ctypes.data, width, 2 * n + 1, u, dt, D)
    deviations(D, numbers[OUTER], circular_states(context), forward)
    covariance(D, numbers[CENTRAL_COV], numbers[OUTER], P)
    add_noise(context, x, u, dt, state, P, matrix(work, at + width, n, n))
    for i in range(n):
        x[i] = forward[i]
    wrap_mean(context, x)


@jit
def only_rounding(U, P, across, S, r, w, y):
    """Whether a reading rests on directions of P that its factor U shows by rounding alone.

    A pivot of a few n ε of P_kk is what subtracting left; its sigma points are then anywhere. That does no harm unless
    they make more than a hundredth of what the reading is weighed against, S (ny, ny) and r: then no gain is known.
    across (nx, ny): the differences between opposite points' readings.
    """
    n = P.shape[0]
    for k in range(n):
        if U[k, k] * U[k, k] <= 4.0 * n * EPSILON * P[k, k]:
            for j in range(r.size):
                d = across[k, j]
                if np.isfinite(y[j]) and 0.5 * w * d * d > 0.01 * (S[j, j] + r[j]):
                    return True
    return False


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """x ← x + C S⁻¹ ν;  P ← P - C S⁻¹ Cᵀ, with C and S from fresh sigma points through h.

    Source: Julier & Uhlmann (2004), as above; sigma points are drawn anew from the prediction, so that they carry Q.
    """
    n = context.nx
    _, m = sensor_rows(context, sensor)
    x = state[:n]
    P = matrix(state, n, n, n)
    D = matrix(work, 0, 2 * n + 1, padded(m))
    at = D.size
    mean = work[at : at + D.shape[1]]
    at += mean.size
    sigma = matrix(work, at, 2 * n + 1, padded(n))
    at += sigma.size
    U = matrix(work, at, n, padded(n))
    nu, r, S, V, C, W, room, _ = shared.scratch(work[at + U.size :], n, m)
    numbers = options(context)
    w = numbers[OUTER]
    spread = numbers[SPREAD]
    if not factor(P, U):
        return FAILED
    spread_points(x, U, spread, sigma)
    expect_rows(context, sensor, sigma.ctypes.data, sigma.shape[1], 2 * n + 1, u, D)
    deviations(D, w, circular_rows(context, sensor), mean)
    covariance(D, numbers[CENTRAL_COV], w, S)
    for i in range(m):
        nu[i] = mean[i]
    # The sigma deviations of the state are ± spread·U[k], so C = w·spread Σ U[k] (D₊ₖ - D₋ₖ).
    across = D[1 : n + 1]
    for k in range(n):
        for j in range(m):
            across[k, j] -= D[1 + n + k, j]
    cross_covariance(U, across, w * spread, C)
    nothing = D[:, :0]
    reading_variances(context, sensor, state, r)
    drowned = only_rounding(U, P, across, S, r, w, y)
    m = compare(context, sensor, y, r, nu, C, S, nothing, P, innovation, innovation_std)
    verdict = FAILED if drowned else admit(context, sensor, m, nu, S, V, score)
    if verdict == USED and numbers[ROBUST] != NONE:
        verdict = USED if reweigh(context, y, r, innovation, m, nu, S, V, room) else FAILED
    if verdict == USED:
        move_mean(m, C, V, nu, x)
        wrap_mean(context, x)
        downdate(m, C, V, P, W)
        if numbers[ADAPT] != OFF:
            adapt(context, sensor, y, state, innovation, innovation_std, score)
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
        Option("kappa", 0.0, -1024.0, 1e4, "", "second spread; nx + kappa must be positive; 3 - nx fits a Gaussian"),
        *OPTIONS,
    ),
    needs_factor=True,
    tune=tune,
    memory=memory,
    refuses=refuses,
)
