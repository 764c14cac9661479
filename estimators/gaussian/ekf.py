"""The extended Kalman filter: mean through f, covariance through its tangent."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..compiled.context import expect, options, row_count, transition
from ..compiled.jacobians import scratch_size, sensor_jacobian, state_jacobian
from ..estimator import Estimator, Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import inlined, jit
from ..numerics.linalg import congruence
from ..numerics.workspace import layout, size_of, start_of, take_matrix, take_vector
from ..track import USED
from ..tuning import Tuning
from .robust import (
    JOSEPH,
    JOSEPH_OPTION,
    OPTIONS,
    adapt,
    add_noise,
    is_adaptive,
    memory,
    reading_variances,
    shared_options,
)
from .shared import (
    Reading,
    admit_weighted,
    compare,
    describe,
    downdate,
    gain,
    joseph,
    moments,
    moments_of,
    move_mean,
    move_to,
    no_points,
    reading_of,
    start,
    state_size,
    wrap_mean,
)


class Predicting(NamedTuple):
    """What `predict` works in."""

    forward: Any
    """(n,): f(x, u)."""
    F: Any
    """(n, n): df/dx."""
    products: Any
    """(2n, n): scratch of F P Fᵀ."""
    Q: Any
    """(n, n): scratch of the noise, once the products are needed no more."""
    jacobian: Any
    """Scratch of a Jacobian."""
    end: int


@layout
def predicting(at, n):
    """The layout of `predict`."""
    forward, at = take_vector(at, n)
    F, at = take_matrix(at, n, n)
    Q, _ = take_matrix(at, n, n)
    products, at = take_matrix(at, 2 * n, n)
    jacobian, at = take_vector(at, scratch_size(n, n))
    return Predicting(forward, F, products, Q, jacobian, at)


class Updating(NamedTuple):
    """What `update` works in."""

    reading: Reading
    K: Any
    """(n, m): the gain."""
    H: Any
    """(m, n): dh/dx."""
    N: Any
    """(n, n): scratch of the Joseph form."""
    jacobian: Any
    """Scratch of a Jacobian."""
    end: int


@layout
def updating(at, n, m):
    """The layout of `update`."""
    reading = reading_of(at, n, m)
    K, at = take_matrix(reading.end, n, m)
    H, at = take_matrix(at, m, n)
    N, at = take_matrix(at, n, n)
    jacobian, at = take_vector(at, scratch_size(n, m))
    return Updating(reading, K, H, N, jacobian, at)


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch of a prediction or an update."""
    return max(size_of(predicting, nx), size_of(updating, nx, ny))


def tune(values: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The shared options alone."""
    return np.array(shared_options(values))


@jit
def predict(context, u, dt, index, state, work):
    """x ← f(x, u);  P ← F P Fᵀ + Q, with F = df/dx at the estimate before the step.

    Source: Jazwinski (1970), Stochastic Processes and Filtering Theory, chapter 8.
    """
    x, P = moments_of(state, context.nx)
    own = predicting(start_of(work), context.nx)
    state_jacobian(context, x, u, dt, own.F, own.jacobian)
    transition(context, x, u, dt, own.forward)
    congruence(own.F, P, own.products)
    # Noise that depends on the state does so where the step began.
    add_noise(context, x, u, dt, state, P, own.Q)
    move_to(context, own.forward, x)


@inlined
def linearise(context, sensor, x, u, P, reading, H, scratch):
    """Fill ŷ = h(x), H = dh/dx (ny, nx), and for the reading C = P Hᵀ and S = H P Hᵀ."""
    C, S = reading.C, reading.S
    n, m = C.shape
    sensor_jacobian(context, sensor, x, u, H, scratch)
    expect(context, sensor, x, u, reading.nu)
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
def correct(context, m, own, x, P):
    """x ← x + K ν;  P by the Joseph form, or as P - K S Kᵀ."""
    reading = own.reading
    C, chol_S = reading.C, reading.chol_S
    if options(context)[JOSEPH] != 0.0:
        gain(m, C, chol_S, own.K)
        move_mean(m, C, chol_S, reading.nu, x)
        joseph(m, reading.d, C, own.H, own.K, P, own.N)
    else:
        move_mean(m, C, chol_S, reading.nu, x)
        downdate(m, C, chol_S, P, reading.W)
    wrap_mean(context, x)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """x ← x + K ν;  P by the Joseph form, with H = dh/dx at the prediction.

    Diverges when h curves strongly within the spread of the prediction: P then shrinks faster than the error.
    Source: Jazwinski (1970), chapter 8.
    """
    x, P = moments_of(state, context.nx)
    own = updating(start_of(work), context.nx, row_count(context, sensor))
    reading = own.reading
    linearise(context, sensor, x, u, P, reading, own.H, own.jacobian)
    reading_variances(context, sensor, state, reading.r)
    m = compare(context, sensor, y, reading, own.H, P, innovation, innovation_std)
    verdict = admit_weighted(context, sensor, m, reading, score)
    if verdict == USED:
        correct(context, m, own, x, P)
        if is_adaptive(context):
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
    singular=True,
)
