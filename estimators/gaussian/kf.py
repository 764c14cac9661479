"""The Kalman filter: exact for a linear model with Gaussian noise."""

from __future__ import annotations

from ..compiled.context import transition
from ..compiled.jacobians import state_jacobian
from ..estimator import Estimator, Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import floats, inlined, jit, matrix
from ..numerics.linalg import congruence
from . import ekf
from .robust import JOSEPH_OPTION, OPTIONS, add_noise, memory
from .shared import describe, moments, no_points, start, state_size, wrap_mean


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: the EKF's for the update; behind it F and the dt for which it holds, kept from step to step."""
    return ekf.work_size(options, nx, ny) + nx * nx + 1


@inlined
def constant_jacobian(context, u, dt, F, last, scratch):
    """Fill F (nx, nx) for this dt, unless it holds it: `last` (1,) is the dt for which it does.

    F is the same at every x of a linear model, so it is found once for each dt, unless inputs may change it.
    """
    if last[0] != dt or u.size > 0:
        # At the prior, not at x: differences round differently at each x, and F must not depend on when it was found.
        state_jacobian(context, floats(context.prior_mean, context.nx), u, dt, F, scratch)
        last[0] = dt


@jit
def predict(context, u, dt, index, state, work):
    """x ← F x + B u;  P ← F P Fᵀ + Q.

    Source: Kalman (1960), doi:10.1115/1.3662552.
    """
    n = context.nx
    x = state[:n]
    P = matrix(state, n, n, n)
    forward = work[:n]
    scratch = matrix(work, n + n * n, 2 * n, n)
    last = work.size - 1
    F = matrix(work, last - n * n, n, n)
    constant_jacobian(context, u, dt, F, work[last:], work[n + 3 * n * n :])
    transition(context, x, u, dt, forward)
    congruence(F, P, scratch)
    add_noise(context, x, u, dt, state, P, scratch[:n])
    for i in range(n):
        x[i] = forward[i]
    wrap_mean(context, x)


def applies(model: StateSpaceModel) -> str | None:
    """Only a linear model has one F and one H."""
    return None if model.linear else f"{model.name} is not linear; use an extended or unscented Kalman filter"


KF = Estimator(
    name="kf",
    title="Kalman filter",
    family="Gaussian",
    assumes="linear f and h, Gaussian noise; then exact",
    model_runs="1",
    fails_when="the model is wrong: the NIS leaves its bounds",
    source="Kalman (1960), doi:10.1115/1.3662552",
    functions=(start, predict, ekf.update, describe),
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    points=no_points,
    options=(JOSEPH_OPTION, *OPTIONS),
    tune=ekf.tune,
    memory=memory,
    applies=applies,
)
