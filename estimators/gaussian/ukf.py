"""The unscented Kalman filter: 2n + 1 sigma points through f and h, without derivatives.

The points are x and x ± √(n+λ) U[i] with P = Uᵀ U and λ = α² (n + κ) - n. Their weights are 1/(2(n+λ)); the central
point has λ/(n+λ) for the mean and λ/(n+λ) + 1 - α² + β for the covariance.

Sources: Julier & Uhlmann (2004), doi:10.1109/JPROC.2003.823141; Wan & van der Merwe (2000),
doi:10.1109/ASSPCC.2000.882463.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compiled.context import (
    circular_rows,
    circular_states,
    estimated,
    expect_points,
    options,
    sensor_rows,
    sensor_variances,
    transition_points,
)
from ..estimator import POINTS, Estimator, Option, Options, SmoothingRule
from ..model.state_space import StateSpaceModel
from ..numerics.jit import by_address, inlined, jit
from ..numerics.linalg import EPSILON, wrap
from ..numerics.simd_ir import padded
from ..numerics.simd_rows import centre, covariance, cross_covariance, factor, spread_points
from ..numerics.workspace import declare_layout, start_of
from ..track import FAILED, USED
from ..tuning import Tuning
from .robust import OPTIONS, OWN, adapt, add_noise, is_adaptive, memory, reading_variances, shared_options
from .shared import (
    admit_weighted,
    compare,
    describe,
    downdate,
    moments,
    moments_of,
    move_mean,
    move_to,
    reading_of,
    start,
    state_size,
    work_of,
    wrap_mean,
)


def tune(values: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """Return the shared options, and the weights."""
    return np.array([*shared_options(values), *weights(values["alpha"], values["beta"], values["kappa"], model.nx)])


def refuses(model: StateSpaceModel, values: Options) -> str | None:
    """Return why kappa is invalid: the spread is the root of a multiple of nx + kappa, which must be positive."""
    kappa = values["kappa"]
    if model.nx + kappa > 0.0:
        return None
    return (
        f"kappa is {kappa:g}, and {model.name} has {model.nx} states; nx + kappa must be positive: give more than "
        f"{-model.nx}, as 3 - nx = {3 - model.nx}"
    )


def points(values: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Return the sigma points (2 nx + 1, nx) of a state."""
    spread = weights(values["alpha"], values["beta"], values["kappa"], nx).spread
    return sigma_points(*moments(values, state, nx), spread)


Predicting, predicting = declare_layout(
    "Predicting",
    "n",
    padded,
    D="2 * n + 1, padded(n)",  # sigma points through f, then their deviations from the mean
    sigma="2 * n + 1, padded(n)",  # sigma points
    mean="padded(n)",  # mean of the sigma points through f
    chol_P="n, padded(n)",  # upper, chol_Pᵀ chol_P = P
    Q="n, n = chol_P",  # scratch of the noise, once the factor is not needed any more
)

Updating, updating = declare_layout(
    "Updating",
    "n, m",
    padded,
    reading_of,
    D="2 * n + 1, padded(m)",  # sigma points through h, then their deviations from the mean
    across="n, padded(m) = D + padded(m)",  # differences between opposite points, in the place of the first ones
    mean="padded(m)",  # mean of the sigma points through h
    sigma="2 * n + 1, padded(n)",  # sigma points
    chol_P="n, padded(n)",  # upper, chol_Pᵀ chol_P = P
    no_H="m, 0",  # there is no Jacobian
    reading="Reading(at, n, m)",
)


@by_address
def predict(context, u, dt, index, state, work):
    """x, P ← mean and covariance of the propagated sigma points, plus Q.

    Fails if P loses positive definiteness: the state becomes NaN, and the twin reports divergence.
    Source: Julier & Uhlmann (2004), doi:10.1109/JPROC.2003.823141.
    """
    n = context.nx
    x, P = moments_of(state, n)
    own = predicting(start_of(work), n)
    w = weights_of(context)
    if not factor(P, own.chol_P):
        state[: n + n * n] = np.nan
        return
    spread_points(x, own.chol_P, w.spread, own.sigma)
    transition_points(context, own.sigma, u, dt, own.D)
    deviations(own.D, w.outer, circular_states(context), own.mean)
    covariance(own.D, w.central, w.outer, P)
    add_noise(context, x, u, dt, state, P, own.Q)
    move_to(context, own.mean, x)


@jit
def only_rounding(U, P, across, S, r, w, y):
    """Return whether an update depends on directions of P that are rounding errors of its factor U.

    A pivot of a few n ε of P_kk is a rounding error, and its sigma points are arbitrary. The update fails if they make
    up more than a hundredth of the innovation's variance, from S (ny, ny) and r. across (nx, ny): the differences
    between predicted measurements of opposite points.
    """
    n = P.shape[0]
    for k in range(n):
        if U[k, k] * U[k, k] <= 4.0 * n * EPSILON * P[k, k]:
            for j in range(r.size):
                d = across[k, j]
                if np.isfinite(y[j]) and 0.5 * w * d * d > 0.01 * (S[j, j] + r[j]):
                    return True
    return False


@inlined
def subtract_opposite(D, m, across):
    """Fill `across` with the differences between the images (m,) of opposite points; it is the first half of D."""
    n = across.shape[0]
    for k in range(n):
        for j in range(m):
            across[k, j] -= D[1 + n + k, j]


SHARP = 1e-8  # R over S below which rounding can leave P without a factor


@inlined
def repair(U, P, scratch):
    """Add rounding errors of the variances before, of Uᵀ U, to a P that subtraction has left without a factor.

    It stays without one if more than rounding is amiss.
    """
    n = P.shape[0]
    share = EPSILON
    while not factor(P, scratch) and share <= 4.0 * n * EPSILON:
        for i in range(n):
            for k in range(i + 1):
                P[i, i] += share * U[k, i] * U[k, i]
        share *= 2.0


@by_address
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """x ← x + C S⁻¹ ν;  P ← P - C S⁻¹ Cᵀ, with C and S from fresh sigma points through h.

    Source: Julier & Uhlmann (2004), as above; sigma points are drawn again from the prediction, so that they include Q.
    """
    x, P = moments_of(state, context.nx)
    own = updating(start_of(work), context.nx, sensor_rows(context, sensor)[1])
    reading = own.reading
    w = weights_of(context)
    if not factor(P, own.chol_P):
        return FAILED
    spread_points(x, own.chol_P, w.spread, own.sigma)
    expect_points(context, sensor, own.sigma, u, own.D)
    deviations(own.D, w.outer, circular_rows(context, sensor), own.mean)
    covariance(own.D, w.central, w.outer, reading.S)
    # The sigma deviations of the state are ± spread·U[k], so C = w·spread Σ U[k] (D₊ₖ - D₋ₖ).
    subtract_opposite(own.D, reading.nu.size, own.across)
    cross_covariance(own.chol_P, own.across, w.outer * w.spread, reading.C)
    for i in range(reading.nu.size):
        reading.nu[i] = own.mean[i]
    reading_variances(context, sensor, state, reading.r)
    drowned = only_rounding(own.chol_P, P, own.across, reading.S, reading.r, w.outer, y)
    m = compare(context, sensor, y, reading, own.no_H, P, innovation, innovation_std)
    verdict = FAILED if drowned else admit_weighted(context, sensor, m, reading, score)
    if verdict == USED:
        move_mean(m, reading.C, reading.chol_S, reading.nu, estimated(context), x)
        wrap_mean(context, x)
        downdate(m, reading.C, reading.chol_S, estimated(context), P, reading.W)
        sharp, r = False, sensor_variances(context, sensor)
        for k in range(r.size):
            sharp |= r[k] < SHARP * innovation_std[k] * innovation_std[k]
        if sharp:
            repair(own.chol_P, P, own.sigma[: context.nx])
        if is_adaptive(context):
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
    work_size=work_of(predicting, updating),
    moments=moments,
    points=points,
    options=(
        Option("alpha", 1.0, 1e-4, 2.0, "", "spread of the sigma points"),
        Option("beta", 2.0, 0.0, 10.0, "", "prior knowledge of the distribution; 2 is optimal for a Gaussian"),
        Option("kappa", 0.0, -1024.0, 1e4, "", "second spread; nx + kappa must be positive; 3 - nx fits a Gaussian"),
        *OPTIONS,
    ),
    needs_factor=True,
    tune=tune,
    memory=memory,
    considers=True,
    smoothing=SmoothingRule(POINTS),
    refuses=refuses,
)


CENTRAL_COV, OUTER, SPREAD = range(OWN, OWN + 3)
"""Positions in the context's options: the central covariance weight, the outer weight, √(n+λ)."""


class Weights(NamedTuple):
    """`central` is the covariance weight of the central point, `outer` that of the others, `spread` is √(n+λ)."""

    central: float
    outer: float
    spread: float


def weights(alpha: float, beta: float, kappa: float, nx: int) -> Weights:
    """The weights and the spread that alpha, beta and kappa give for nx states."""
    total = alpha**2 * (nx + kappa)
    central = 1.0 - nx / total
    return Weights(central + 1.0 - alpha**2 + beta, 0.5 / total, float(np.sqrt(total)))


@inlined
def weights_of(context):
    """The weights and the spread that the filter's `tune` found."""
    numbers = options(context)
    return Weights(numbers[CENTRAL_COV], numbers[OUTER], numbers[SPREAD])


def sigma_points(x: np.ndarray, P: np.ndarray, spread: float) -> np.ndarray:
    """The sigma points (2 nx + 1, nx) of a mean and covariance; none where the covariance has no factor."""
    try:
        U = np.linalg.cholesky(P).T * spread
    except np.linalg.LinAlgError:
        return np.zeros((0, x.size))
    return np.vstack((x, x + U, x - U))


@inlined
def deviations(D, w, circular, mean):
    """Turn points D (2n+1, padded k) into deviations from their weighted mean (padded k,), from the central point on.

    The weights sum to 1, so mean = D₀ + w Σ (Dᵢ - D₀): small alpha then costs no digits, and angles do not tear.
    """
    for j in range(circular.size):
        if circular[j] != 0:
            for i in range(1, D.shape[0]):
                d = D[i, j] - D[0, j]
                if abs(d) > np.pi:
                    D[i, j] = D[0, j] + wrap(d)
    centre(D, circular.size, w, mean)
