"""The extended Kalman filter: mean through f, covariance through its tangent."""

from __future__ import annotations

from .context import add_process_noise, expect, sensor_rows, transition
from .filter import Estimator, Options
from .gaussian import (
    compare,
    describe,
    gain,
    joseph,
    judge,
    moments,
    move_mean,
    no_points,
    start,
    state_size,
    wrap_mean,
)
from .jacobians import scratch_size, sensor_jacobian, state_jacobian
from .jit import jit, matrix
from .linalg import congruence
from .track import USED


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: x', F and twice the square for the congruence; or ŷ, S, its factor, C, K, H, a square; a Jacobian's."""
    filters = max(nx + 3 * nx * nx, ny + 2 * ny * ny + 3 * nx * ny + nx * nx)
    return filters + scratch_size(nx, ny)


@jit
def predict(context, u, dt, index, state, work):
    """x ← f(x, u);  P ← F P Fᵀ + Q, with F = df/dx at the estimate before the step.

    Source: Jazwinski (1970), Stochastic Processes and Filtering Theory, theorem 8.1.
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
    add_process_noise(context, x, u, dt, P, scratch[:n])
    for i in range(n):
        x[i] = forward[i]
    wrap_mean(context, x)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """x ← x + K ν;  P by the Joseph form, with H = dh/dx at the prediction.

    Diverges when h curves strongly within the spread of the prediction: P then shrinks faster than the error.
    Source: Jazwinski (1970), theorem 8.1.
    """
    n = context.nx
    _, m = sensor_rows(context, sensor)
    x = state[:n]
    P = matrix(state, n, n, n)
    at = 0
    nu = work[at : at + m]
    at += m
    S = matrix(work, at, m, m)
    at += m * m
    U = matrix(work, at, m, m)
    at += m * m
    C = matrix(work, at, n, m)
    at += n * m
    K = matrix(work, at, n, m)
    at += n * m
    H = matrix(work, at, m, n)
    at += n * m
    N = matrix(work, at, n, n)
    sensor_jacobian(context, sensor, x, u, H, work[at + n * n :])
    expect(context, sensor, x, u, nu)
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
    m = compare(context, sensor, y, nu, C, S, H, innovation, innovation_std)
    verdict = judge(context, sensor, m, nu, S, U, score)
    if verdict == USED:
        gain(m, C, U, K)
        move_mean(m, C, U, nu, x)
        wrap_mean(context, x)
        joseph(context, sensor, y, m, C, H, K, P, N)
    return verdict


EKF = Estimator(
    name="ekf",
    title="Extended Kalman filter",
    family="Gaussian",
    assumes="differentiable f and h, nearly straight within the spread of the estimate",
    model_runs="1 and its derivatives (nx by complex step)",
    fails_when="curvature makes it overconfident: it stops listening to the sensors",
    source="Jazwinski (1970), Stochastic Processes and Filtering Theory, theorem 8.1",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: nx + 1,
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    points=no_points,
)
