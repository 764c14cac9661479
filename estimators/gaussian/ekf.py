"""The extended Kalman filter: mean through f, covariance through its tangent."""

from __future__ import annotations

import numpy as np

from ..compiled.context import expect, options, sensor_rows, transition
from ..compiled.jacobians import scratch_size, sensor_jacobian, state_jacobian
from ..estimator import Estimator, Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import inlined, jit, matrix
from ..numerics.linalg import congruence
from ..track import FAILED, USED
from ..tuning import Tuning
from . import shared
from .robust import (
    ADAPT,
    JOSEPH,
    JOSEPH_OPTION,
    NONE,
    OFF,
    OPTIONS,
    ROBUST,
    adapt,
    add_noise,
    memory,
    reading_variances,
    reweigh,
    shared_options,
)
from .shared import (
    admit,
    compare,
    describe,
    downdate,
    gain,
    joseph,
    moments,
    move_mean,
    no_points,
    start,
    state_size,
    wrap_mean,
)


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: x', F and twice the square for the congruence; or an update's, with K, H, a square; a Jacobian's."""
    filters = max(nx + 3 * nx * nx, shared.scratch_size(nx, ny) + 2 * nx * ny + nx * nx)
    return filters + scratch_size(nx, ny)


def tune(values: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The shared options alone."""
    return np.array(shared_options(values))


@jit
def predict(context, u, dt, index, state, work):
    """x ← f(x, u);  P ← F P Fᵀ + Q, with F = df/dx at the estimate before the step.

    Source: Jazwinski (1970), Stochastic Processes and Filtering Theory, chapter 8.
    """
    n = context.nx
    x = state[:n]
    P = matrix(state, n, n, n)
    forward = work[:n]
    F = matrix(work, n, n, n)
    scratch = matrix(work, n + n * n, 2 * n, n)
    state_jacobian(context, x, u, dt, F, work[n + 3 * n * n :])
    transition(context, x, u, dt, forward)
    congruence(F, P, scratch)
    # Noise that depends on the state does so where the step began.
    add_noise(context, x, u, dt, state, P, scratch[:n])
    for i in range(n):
        x[i] = forward[i]
    wrap_mean(context, x)


@inlined
def linearise(context, sensor, x, u, P, expected, C, S, H, scratch):
    """Fill h(x) (ny,), H = dh/dx (ny, nx), C = P Hᵀ and S = H P Hᵀ."""
    n = x.size
    m = expected.size
    sensor_jacobian(context, sensor, x, u, H, scratch)
    expect(context, sensor, x, u, expected)
    for i in range(n):
        for k in range(m):
            s = 0.0
            for j in range(n):
                s += P[i, j] * H[k, j]
            C[i, k] = s
    for k in range(m):
        for i in range(m):
            s = 0.0
            for j in range(n):
                s += H[k, j] * C[j, i]
            S[k, i] = s


@inlined
def correct(context, y, r, m, nu, U, C, W, K, H, N, x, P):
    """x ← x + K ν;  P by the Joseph form, or as P - K S Kᵀ; from the whitened nu, S = Uᵀ U and C = P Hᵀ."""
    if options(context)[JOSEPH] != 0.0:
        gain(m, C, U, K)
        move_mean(m, C, U, nu, x)
        joseph(y, r, m, C, H, K, P, N)
    else:
        move_mean(m, C, U, nu, x)
        downdate(m, C, U, P, W)
    wrap_mean(context, x)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """x ← x + K ν;  P by the Joseph form, with H = dh/dx at the prediction.

    Diverges when h curves strongly within the spread of the prediction: P then shrinks faster than the error.
    Source: Jazwinski (1970), chapter 8.
    """
    n = context.nx
    _, m = sensor_rows(context, sensor)
    x = state[:n]
    P = matrix(state, n, n, n)
    nu, r, S, U, C, W, room, at = shared.scratch(work, n, m)
    K = matrix(work, at, n, m)
    H = matrix(work, at + n * m, m, n)
    N = matrix(work, at + 2 * n * m, n, n)
    linearise(context, sensor, x, u, P, nu, C, S, H, work[at + 2 * n * m + n * n :])
    reading_variances(context, sensor, state, r)
    m = compare(context, sensor, y, r, nu, C, S, H, P, innovation, innovation_std)
    verdict = admit(context, sensor, m, nu, S, U, score)
    if verdict == USED and options(context)[ROBUST] != NONE:
        verdict = USED if reweigh(context, y, r, innovation, m, nu, S, U, room) else FAILED
    if verdict == USED:
        correct(context, y, r, m, nu, U, C, W, K, H, N, x, P)
        if options(context)[ADAPT] != OFF:
            adapt(context, sensor, y, state, innovation, innovation_std, score)
    return verdict


EKF = Estimator(
    name="ekf",
    title="Extended Kalman filter",
    family="Gaussian",
    assumes="differentiable f and h, nearly straight within the spread of the estimate",
    model_runs="1 and its derivatives (nx by complex step)",
    fails_when="curvature makes it overconfident: it stops listening to the sensors",
    source="Jazwinski (1970), Stochastic Processes and Filtering Theory, chapter 8",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: nx + 1,
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    points=no_points,
    options=(JOSEPH_OPTION, *OPTIONS),
    tune=tune,
    memory=memory,
)
