"""The square-root Kalman filter: exact for a linear model, on a factor of P, by Householder triangularisation."""

from __future__ import annotations

from ..compiled.context import transition
from ..estimator import Estimator, Options
from ..numerics.jit import jit, matrix
from . import sr_ekf
from .kf import applies, constant_jacobian
from .robust import OPTIONS, memory
from .shared import no_points, state_size
from .square_root import describe, moments, start


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: the square-root EKF's; behind it F and the dt for which it holds, kept from step to step."""
    return sr_ekf.work_size(options, nx, ny) + nx * nx + 1


@jit
def predict(context, u, dt, index, state, work):
    """x ← F x + B u;  Uᵀ U ← F Uᵀ U Fᵀ + Q.

    Source: Kailath, Sayed & Hassibi, Linear Estimation (2000), chapter 12.
    """
    n = context.nx
    forward = work[:n]
    last = work.size - 1
    F = matrix(work, last - n * n, n, n)
    constant_jacobian(context, u, dt, F, work[last:], work[n + 4 * n * n :])
    transition(context, state[:n], u, dt, forward)
    A = matrix(work, n + n * n, 2 * n, n)
    sr_ekf.advance(context, u, dt, state, forward, F, A, matrix(work, n + 3 * n * n, n, n))


SR_KF = Estimator(
    name="sr-kf",
    title="Square-root Kalman filter",
    family="Gaussian",
    assumes="linear f and h, Gaussian noise; then exact, at any conditioning",
    model_runs="1",
    fails_when="the model is wrong: the NIS leaves its bounds",
    source="Kailath, Sayed & Hassibi (2000), Linear Estimation, chapter 12",
    functions=(start, predict, sr_ekf.update, describe),
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    points=no_points,
    options=OPTIONS,
    tune=sr_ekf.tune,
    memory=memory,
    applies=applies,
)
