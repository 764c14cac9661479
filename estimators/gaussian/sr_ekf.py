"""The square-root extended Kalman filter: the EKF on a factor of P, by Householder triangularisation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..compiled.context import estimated, expect, sensor_rows, transition
from ..compiled.jacobians import scratch_size, sensor_jacobian, state_jacobian
from ..estimator import FACTOR, TANGENT, SmoothingRule
from ..numerics.jit import by_address, inlined, part
from ..numerics.linalg import triangularise
from ..numerics.workspace import declare_layout, start_of, take_matrix
from .ekf import EKF
from .robust import OPTIONS, growth
from .shared import moments_of, move_to, work_of
from .square_root import condition, conditioning, describe, moments, noise_root, settle, start

Predicting, predicting = declare_layout(
    "Predicting",
    "n",
    scratch_size,
    forward="n",  # f(x, u)
    F="n, n",  # df/dx
    A="2 * n, n",  # U Fᵀ over Q^½
    scratch="n, n",  # Q, then scratch of a triangularisation
    jacobian="scratch_size(n, n)",  # scratch of a Jacobian
)

Updating, updating = declare_layout(
    "Updating",
    "n, m",
    scratch_size,
    conditioning,
    expected="m",  # h(x)
    H="m, n",  # dh/dx
    Y="n, m",  # U Hᵀ
    nothing="0",  # no weight is negative
    jacobian="scratch_size(n, m)",  # scratch of a Jacobian
    conditioning="Conditioning(at, n, m, n)",
)


work_size = work_of(predicting, updating)


@inlined
def turn(U, F, first, a, out):
    """Leading rows of `out` (n or more, k) = a U Fᵀ, with F (k, n) and U upper above its border from row `first` on."""
    n = U.shape[0]
    for i in range(n):
        for k in range(out.shape[1]):
            s = 0.0
            for j in range(i if i < first else 0, n):
                s += U[i, j] * F[k, j]
            out[i, k] = a * s


@inlined
def advance(context, u, dt, state, own, F):
    """x ← f(x, u);  U ← triangle of [U Fᵀ; Q^½]."""
    n = context.nx
    x, U = moments_of(state, n)
    good = noise_root(context, x, u, dt, state, own.A[n:], own.scratch)
    grown = np.sqrt(growth(context, dt))
    if estimated(context) < n:
        advance_bordered(U, F, estimated(context), grown, own.A, own.scratch, own.jacobian, good)
        for i in range(n):
            own.forward[i] = own.forward[i] if good else np.nan
        move_to(context, own.forward, x)
    else:
        turn(U, F, n, grown, own.A)
        triangularise(own.A, own.scratch[0])
        settle(context, own.forward, own.A, good, state)


@part
def advance_bordered(U, F, first, a, A, N, w, good):
    """U_ec ← a (U_ec F_eᵀ + U_c F_cᵀ);  U_e ← triangle of [a U_e F_eᵀ; Q^½], with F = [F_e F_c; 0 I]; NaN if not good.

    On entry A (2n, n) holds Q^½ from row n on; N (n, n) and w (n or more,) are scratch.
    """
    n = U.shape[0]
    for i in range(first):
        for j in range(first):
            N[i, j] = A[n + i, j]
    T, _ = take_matrix(start_of(A), 2 * first, first)
    for i in range(n):
        for k in range(first):
            s = 0.0
            for j in range(i if i < first else 0, first if i < first else n):
                s += U[i, j] * F[k, j]
            w[k] = a * s
        for k in range(first):
            if i < first:
                T[i, k] = w[k]
                T[first + i, k] = N[i, k]
            else:
                U[i, k] = w[k] if good else np.nan
    triangularise(T, w)
    for i in range(first):
        for j in range(i, first):
            U[i, j] = T[i, j] if good else np.nan


@by_address
def predict(context, u, dt, index, state, work):
    """x ← f(x, u);  Uᵀ U ← F Uᵀ U Fᵀ + Q, with F = df/dx at the estimate before the step.

    Source: Kailath, Sayed & Hassibi, Linear Estimation (2000), chapter 12.
    """
    x, _ = moments_of(state, context.nx)
    own = predicting(start_of(work), context.nx)
    state_jacobian(context, x, u, dt, own.F, own.jacobian)
    transition(context, x, u, dt, own.forward)
    advance(context, u, dt, state, own, own.F)


@by_address
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """One triangularisation of [U Hᵀ, U; R^½, 0], with H = dh/dx at the prediction.

    Source: Kailath, Sayed & Hassibi, Linear Estimation (2000), chapter 12.
    """
    x, U = moments_of(state, context.nx)
    own = updating(start_of(work), context.nx, sensor_rows(context, sensor)[1])
    sensor_jacobian(context, sensor, x, u, own.H, own.jacobian)
    expect(context, sensor, x, u, own.expected)
    bordered = context.n_considered > 0
    turn(U, own.H, estimated(context), 1.0, own.Y)
    return condition(
        context, sensor, y, state, own.expected, own.Y, own.nothing, own.conditioning, innovation, innovation_std,
        score, bordered,
    )  # fmt: skip


SR_EKF = replace(
    EKF,
    name="sr-ekf",
    title="Square-root extended Kalman filter",
    assumes="differentiable f and h, nearly straight within the spread of the estimate; any conditioning",
    source="Kailath, Sayed & Hassibi (2000), Linear Estimation, chapter 12",
    functions=(start, predict, update, describe),
    work_size=work_size,
    moments=moments,
    smoothing=SmoothingRule(TANGENT, FACTOR),
    options=OPTIONS,
)
