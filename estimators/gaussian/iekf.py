"""The iterated extended Kalman filter: the update is linearised again at its own result until that converges."""

from __future__ import annotations

import numpy as np

from ..compiled.context import options, row_count
from ..estimator import Estimator, Option, Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import by_address, inlined
from ..numerics.linalg import solve_transposed
from ..numerics.workspace import declare_layout, size_of, start_of
from ..track import FAILED, USED
from ..tuning import Tuning
from . import ekf
from .ekf import correct, linearise, predict, predicting
from .robust import (
    JOSEPH_OPTION,
    OPTIONS,
    OWN,
    adapt,
    is_adaptive,
    memory,
    reading_variances,
    shared_options,
)
from .shared import (
    admit_weighted,
    compare,
    describe,
    factor,
    moments,
    moments_of,
    move_mean,
    no_points,
    start,
    state_size,
)

ITERATIONS = OWN
"""Position in the context's options."""


Iterating, iterating = declare_layout(
    "Iterating",
    "n, m",
    ekf.updating,
    own="Updating(at, n, m)",
    predicted="n",  # x̂, the prediction
    innovation="m",  # y - h(xᵢ), of which the track keeps the first
    innovation_std="m",  # standard deviations of the innovation
)


def work_size(options: Options, nx: int, ny: int) -> int:
    """Return the scratch of a prediction or an update."""
    return max(size_of(predicting, nx), size_of(iterating, nx, ny))


def tune(values: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The shared options, and the number of iterations."""
    return np.array([*shared_options(values), values["iterations"]])


@by_address
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """The Gauss-Newton minimum of ½ |x - x̂|²_P⁻¹ + ½ |y - h(x)|²_R⁻¹, then P by the Joseph form with its last H.

    xᵢ₊₁ = x̂ + Kᵢ (y - h(xᵢ) - Hᵢ (x̂ - xᵢ)),  x₀ = x̂. Each step starts from the prediction x̂ and its P, so that the
    measurement counts once; NIS, gate and weight are those of the prediction. One iteration is the EKF.

    Source: Bell & Cathey (1993), doi:10.1109/9.250476.
    """
    x, P = moments_of(state, context.nx)
    places = iterating(start_of(work), context.nx, row_count(context, sensor))
    predicted, own = places.predicted, places.own
    reading, H = own.reading, own.H
    reading_variances(context, sensor, state, reading.r)
    for i in range(x.size):
        predicted[i] = x[i]
    iterations = int(options(context)[ITERATIONS])
    verdict = USED
    m = np.int64(0)  # a literal would be a second type, and compile every callee twice
    for iteration in range(iterations):
        linearise(context, sensor, x, u, P, reading, H, own.jacobian)
        m = compare(context, sensor, y, reading, H, P, places.innovation, places.innovation_std)
        back_to(predicted, m, H, x, reading.nu)
        if iteration == 0:
            tell(y, places.innovation, places.innovation_std, innovation, innovation_std)
            verdict = admit_weighted(context, sensor, m, reading, score)
        elif factor(reading.S, reading.chol_S, m, x.size):
            solve_transposed(reading.chol_S, m, reading.nu)
        else:
            verdict = FAILED
        if verdict != USED:
            break
        if iteration < iterations - 1:
            move_mean(m, reading.C, reading.chol_S, reading.nu, x)
    if verdict == USED:
        correct(context, m, own, x, P)
        if is_adaptive(context):
            adapt(context, sensor, y, state, innovation, innovation_std, score)
    return verdict


@inlined
def back_to(predicted, m, H, x, nu):
    """ν ← ν - Hᵢ (x̂ - xᵢ);  xᵢ ← x̂."""
    for k in range(m):
        for j in range(x.size):
            nu[k] -= H[k, j] * (predicted[j] - x[j])
    for j in range(x.size):
        x[j] = predicted[j]


@inlined
def tell(y, nu, nu_std, innovation, innovation_std):
    """Fill the track's innovation and its standard deviations in the finite rows of the measurement."""
    for i in range(nu.size):
        if np.isfinite(y[i]):
            innovation[i] = nu[i]
            innovation_std[i] = nu_std[i]


IEKF = Estimator(
    name="iekf",
    title="Iterated extended Kalman filter",
    family="Gaussian",
    assumes="differentiable f and h; h may curve within the spread, if the posterior has one peak",
    model_runs="1, and h once an iteration; each and its derivatives (nx by complex step)",
    fails_when="Gauss-Newton overshoots or two peaks fit; f's curvature makes it overconfident like the EKF",
    source="Bell & Cathey (1993), doi:10.1109/9.250476",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: nx + 1,
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    points=no_points,
    options=(
        Option("iterations", 3, 1, 100, "", "linearisations per measurement; 1 is the EKF"),
        JOSEPH_OPTION,
        *OPTIONS,
    ),
    tune=tune,
    memory=memory,
    singular=True,
)
