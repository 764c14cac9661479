"""The iterated extended Kalman filter: the update linearised again where it leads, until it stays there."""

from __future__ import annotations

import numpy as np

from ..compiled.context import options, sensor_rows
from ..estimator import Estimator, Option, Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import jit, matrix
from ..numerics.linalg import solve_transposed
from ..track import FAILED, USED
from ..tuning import Tuning
from . import ekf, shared
from .ekf import correct, linearise, predict
from .robust import (
    ADAPT,
    JOSEPH_OPTION,
    NONE,
    OFF,
    OPTIONS,
    OWN,
    ROBUST,
    adapt,
    memory,
    reading_variances,
    reweigh,
    shared_options,
)
from .shared import admit, compare, describe, factor, moments, move_mean, no_points, start, state_size

ITERATIONS = OWN
"""Position in the context's options."""


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: the EKF's, and the prediction."""
    return ekf.work_size(options, nx, ny) + nx + 2 * ny


def tune(values: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The shared options, and the number of iterations."""
    return np.array([*shared_options(values), values["iterations"]])


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """The Gauss-Newton minimum of ½ |x - x̂|²_P⁻¹ + ½ |y - h(x)|²_R⁻¹, then P by the Joseph form with its last H.

    xᵢ₊₁ = x̂ + Kᵢ (y - h(xᵢ) - Hᵢ (x̂ - xᵢ)),  x₀ = x̂. Each step starts from the prediction x̂ and its P again, so that
    the reading counts once; NIS, gate and weight are those of the prediction. One iteration is the EKF.

    Source: Bell & Cathey (1993), doi:10.1109/9.250476.
    """
    n = context.nx
    _, ny = sensor_rows(context, sensor)
    x = state[:n]
    P = matrix(state, n, n, n)
    nu, r, S, U, C, W, room, at = shared.scratch(work, n, ny)
    K = matrix(work, at, n, ny)
    H = matrix(work, at + n * ny, ny, n)
    at += 2 * n * ny
    N = matrix(work, at, n, n)
    at += n * n
    predicted = work[at : at + n]
    at += n
    aside = work[at : at + ny]
    aside_std = work[at + ny : at + 2 * ny]
    scratch = work[at + 2 * ny :]
    linearise(context, sensor, x, u, P, nu, C, S, H, scratch)
    reading_variances(context, sensor, state, r)
    m = compare(context, sensor, y, r, nu, C, S, H, P, innovation, innovation_std)
    verdict = admit(context, sensor, m, nu, S, U, score)
    if verdict == USED and options(context)[ROBUST] != NONE:
        verdict = USED if reweigh(context, y, r, innovation, m, nu, S, U, room) else FAILED
    if verdict != USED:
        return verdict
    for i in range(n):
        predicted[i] = x[i]
    for _ in range(int(options(context)[ITERATIONS]) - 1):
        for i in range(n):
            x[i] = predicted[i]
        move_mean(m, C, U, nu, x)
        linearise(context, sensor, x, u, P, nu, C, S, H, scratch)
        compare(context, sensor, y, r, nu, C, S, H, P, aside, aside_std)
        for k in range(m):
            for j in range(n):
                nu[k] -= H[k, j] * (predicted[j] - x[j])
        if not factor(S, U, m, n):
            verdict = FAILED
            break
        solve_transposed(U, m, nu)
    for i in range(n):
        x[i] = predicted[i]
    if verdict == USED:
        correct(context, y, r, m, nu, U, C, W, K, H, N, x, P)
        if options(context)[ADAPT] != OFF:
            adapt(context, sensor, y, state, innovation, innovation_std, score)
    return verdict


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
        Option("iterations", 3, 1, 100, "", "linearisations of a reading; 1 is the EKF"),
        JOSEPH_OPTION,
        *OPTIONS,
    ),
    tune=tune,
    memory=memory,
)
