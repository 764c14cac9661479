"""The Kalman filter: exact for a linear model with Gaussian noise."""

from __future__ import annotations

from dataclasses import replace

from ..compiled.context import estimated, transition
from ..compiled.jacobians import state_jacobian
from ..estimator import CONSTANT, Options, SmoothingRule
from ..model.state_space import StateSpaceModel
from ..numerics.jit import by_address, floats, inlined
from ..numerics.linalg import congruence
from ..numerics.workspace import declare_layout, size_of, start_of
from . import ekf
from .ekf import EKF, predicting
from .robust import add_noise
from .shared import describe, moments_of, move_to, start

Kept, kept = declare_layout(
    "Kept",
    "n",
    F="n, n",  # transition matrix
    dt="1",  # step for which F holds; NaN at first
)
"""Workspace that keeps its numbers from step to step."""


@inlined
def kept_in(work, n):
    """Return the kept numbers, at the end of the scratch, where no step works."""
    return kept(start_of(work[work.size - (n * n + 1) :]), n)


def work_size(options: Options, nx: int, ny: int) -> int:
    """Return the scratch: the EKF's, and the kept numbers."""
    return ekf.work_size(options, nx, ny) + size_of(kept, nx)


@inlined
def constant_jacobian(context, u, dt, kept, scratch):
    """Fill F for this dt, unless it has been computed for it.

    F of a linear model is the same at every x, so it is computed once per dt, unless inputs may change it.
    """
    if kept.dt[0] != dt or u.size > 0:
        # At the prior, not at x: differences round differently at each x, and F must not depend on when it is computed.
        state_jacobian(context, floats(context.prior_mean, context.nx), u, dt, kept.F, scratch)
        kept.dt[0] = dt


@by_address
def predict(context, u, dt, index, state, work):
    """x ← F x + B u;  P ← F P Fᵀ + Q.

    Source: Kalman (1960), doi:10.1115/1.3662552.
    """
    n = context.nx
    x, P = moments_of(state, n)
    own = predicting(start_of(work), n)
    constant = kept_in(work, n)
    constant_jacobian(context, u, dt, constant, own.jacobian)
    transition(context, x, u, dt, own.forward)
    congruence(constant.F, estimated(context), P, own.products)
    add_noise(context, x, u, dt, state, P, own.Q)
    move_to(context, own.forward, x)


def applies(model: StateSpaceModel) -> str | None:
    """Return why the filter does not apply: only a linear model has one F and one H."""
    if model.linear:
        return None
    names = model.state_names[model.nx - model.considered :]
    why = f" once {', '.join(names)} are considered: they multiply states, or are bounded" if names else ""
    return f"{model.name} is not linear{why}; use an extended or unscented Kalman filter: ekf, ukf, sr-ekf or sr-ukf"


KF = replace(
    EKF,
    name="kf",
    title="Kalman filter",
    assumes="linear f and h, Gaussian noise; then exact",
    model_runs="1",
    fails_when="the model is wrong: the NIS leaves its bounds",
    source="Kalman (1960), doi:10.1115/1.3662552",
    functions=(start, predict, ekf.update, describe),
    runs=lambda options, nx: 1.0,
    work_size=work_size,
    linearises=False,
    smoothing=SmoothingRule(CONSTANT),
    applies=applies,
)
