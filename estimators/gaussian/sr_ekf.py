"""The square-root extended Kalman filter: the EKF on a factor of P, by Householder triangularisation."""

from __future__ import annotations

import numpy as np

from ..compiled.context import expect, sensor_rows, transition
from ..compiled.jacobians import scratch_size, sensor_jacobian, state_jacobian
from ..estimator import Estimator, Options
from ..numerics.jit import inlined, jit, matrix
from ..numerics.linalg import triangularise
from .ekf import tune
from .robust import OPTIONS, growth, memory
from .shared import no_points, state_size
from .square_root import condition, condition_size, describe, moments, noise_root, settle, start


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: x', F and two squares; or ŷ, H, U Hᵀ, what conditioning takes; a Jacobian's."""
    return max(nx + 4 * nx * nx, ny + 2 * nx * ny + condition_size(nx, ny, 0)) + scratch_size(nx, ny)


@inlined
def advance(context, u, dt, state, forward, F, A, scratch):
    """x ← forward;  U ← triangle of [U Fᵀ; Q^½], in A (2n, n); scratch is (nx, nx)."""
    n = context.nx
    U = matrix(state, n, n, n)
    V = A[n:]
    good = noise_root(context, state[:n], u, dt, state, V, scratch)
    grown = np.sqrt(growth(context, dt))
    for i in range(n):
        for k in range(n):
            s = 0.0
            for j in range(i, n):
                s += U[i, j] * F[k, j]
            A[i, k] = grown * s
    triangularise(A, scratch[0])
    settle(context, forward, U, A, good, state)


@jit
def predict(context, u, dt, index, state, work):
    """x ← f(x, u);  Uᵀ U ← F Uᵀ U Fᵀ + Q, with F = df/dx at the estimate before the step.

    Source: Kailath, Sayed & Hassibi, Linear Estimation (2000), chapter 12.
    """
    n = context.nx
    x = state[:n]
    forward = work[:n]
    F = matrix(work, n, n, n)
    state_jacobian(context, x, u, dt, F, work[n + 4 * n * n :])
    transition(context, x, u, dt, forward)
    advance(context, u, dt, state, forward, F, matrix(work, n + n * n, 2 * n, n), matrix(work, n + 3 * n * n, n, n))


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """One triangularisation of [U Hᵀ, U; R^½, 0], with H = dh/dx at the prediction.

    Source: Kailath, Sayed & Hassibi, Linear Estimation (2000), chapter 12.
    """
    n = context.nx
    _, m = sensor_rows(context, sensor)
    x = state[:n]
    U = matrix(state, n, n, n)
    expected = work[:m]
    H = matrix(work, m, m, n)
    Y = matrix(work, m + n * m, n, m)
    at = m + 2 * n * m
    sensor_jacobian(context, sensor, x, u, H, work[at:])
    expect(context, sensor, x, u, expected)
    for i in range(n):
        for k in range(m):
            s = 0.0
            for j in range(i, n):
                s += U[i, j] * H[k, j]
            Y[i, k] = s
    return condition(context, sensor, y, state, expected, Y, work[:0], work[at:], innovation, innovation_std, score)


SR_EKF = Estimator(
    name="sr-ekf",
    title="Square-root extended Kalman filter",
    family="Gaussian",
    assumes="differentiable f and h, nearly straight within the spread of the estimate; any conditioning",
    model_runs="1 and its derivatives (nx by complex step)",
    fails_when="curvature makes it overconfident: it stops listening to the sensors",
    source="Kailath, Sayed & Hassibi (2000), Linear Estimation, chapter 12",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: nx + 1,
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    points=no_points,
    options=OPTIONS,
    tune=tune,
    memory=memory,
)
