"""The extended Kalman filter: mean through f, covariance through its tangent."""

from __future__ import annotations

import numpy as np

from ..compiled.context import estimated, expect, options, sensor_rows, transition
from ..compiled.jacobians import scratch_size, sensor_jacobian, state_jacobian
from ..estimator import TANGENT, Estimator, Options, SmoothingRule
from ..model.state_space import StateSpaceModel
from ..numerics.jit import by_address, embedded, inlined, part
from ..numerics.linalg import congruence, copy_vector, mirror, multiply_transposed, solve_transposed
from ..numerics.simd import dot
from ..numerics.simd_ir import LANES
from ..numerics.simd_rows import multiply_rows
from ..numerics.workspace import declare_layout, start_of
from ..track import FAILED, USED
from ..tuning import Tuning
from .robust import (
    JOSEPH,
    JOSEPH_OPTION,
    OPTIONS,
    OWN,
    adapt,
    add_noise,
    is_adaptive,
    memory,
    reading_variances,
    shared_options,
)
from .shared import (
    admit_weighted,
    compare,
    describe,
    downdate,
    factor,
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
    work_of,
    wrap_mean,
)

ITERATIONS = OWN
"""Position in the context's options: most iterations of the update."""

SETTLED = 1e-10
"""Size of the step, in deviations of the prediction, that ends the iterations."""

Predicting, predicting = declare_layout(
    "Predicting",
    "n",
    scratch_size,
    forward="n",  # f(x, u)
    F="n, n",  # df/dx
    products="2 * n, n",  # scratch of F P Fᵀ
    Q="n, n = products",  # scratch of the noise, once the products are not needed any more
    jacobian="scratch_size(n, n)",  # scratch of a Jacobian
)

Updating, updating = declare_layout(
    "Updating",
    "n, m",
    reading_of,
    scratch_size,
    reading="Reading(at, n, m)",
    K="n, m",  # gain
    H="m, n",  # dh/dx
    N="n, n",  # scratch of the Joseph form
    last="n",  # mean of the iteration before
    jacobian="scratch_size(n, m)",  # scratch of a Jacobian
)


work_size = work_of(predicting, updating)


def tune(values: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """Return the shared options, and the most iterations of the update: one but for iekf.py."""
    return np.array([*shared_options(values), values.get("iterations", 1.0)])


@by_address
def predict(context, u, dt, index, state, work):
    """x ← f(x, u);  P ← F P Fᵀ + Q, with F = df/dx at the estimate before the step.

    Source: Jazwinski (1970), Stochastic Processes and Filtering Theory, chapter 8.
    """
    x, P = moments_of(state, context.nx)
    own = predicting(start_of(work), context.nx)
    state_jacobian(context, x, u, dt, own.F, own.jacobian)
    transition(context, x, u, dt, own.forward)
    congruence(own.F, estimated(context), P, own.products)
    # Noise that depends on the state does so where the step began.
    add_noise(context, x, u, dt, state, P, own.Q)
    move_to(context, own.forward, x)


@inlined
def sparse_product(P, H, C):
    """C = P Hᵀ, where most of H is zero, as a sensor sees few of the states and the considered ones."""
    C[:] = 0.0
    for k in range(H.shape[0]):
        for j in range(H.shape[1]):
            a = H[k, j]
            if a != 0.0:
                for i in range(C.shape[0]):
                    C[i, k] += a * P[j, i]


@embedded
def linearise(context, sensor, x, u, P, reading, H, scratch):
    """Fill ŷ = h(x), H = dh/dx (ny, nx), C = P Hᵀ and S = H P Hᵀ."""
    sensor_jacobian(context, sensor, x, u, H, scratch)
    expect(context, sensor, x, u, reading.nu)
    project(P, H, estimated(context), reading.C, reading.S, reading.W)


@embedded
def project(P, H, estimated, C, S, W):
    """C = P Hᵀ (nx, ny) and S = H C (ny, ny); `estimated` states are not considered; W as for `downdate`."""
    n, m = C.shape
    if n >= LANES:
        project_rows(P, H, C, S, W)
        return
    if estimated < n:
        sparse_product(P, H, C)
    else:
        multiply_transposed(P, H, C)
    for k in range(m):
        for i in range(m):
            s = 0.0
            for j in range(n):
                s += H[k, j] * C[j, i]
            S[k, i] = s


@part
def project_rows(P, H, C, S, W):
    """As `project`, in whole vectors; zeros of H are skipped."""
    n, m = C.shape
    multiply_rows(H, m, n, P, 0, W)
    for i in range(n):
        for k in range(m):
            C[i, k] = W[k, i]
    if m >= LANES:
        multiply_rows(H, m, n, C, 1, S)
    else:
        for k in range(m):
            for i in range(k + 1):
                S[k, i] = dot(n, H[k], W[i])
    mirror(S)


@inlined
def narrow(context, m, own, P):
    """P by the Joseph form, or as P - K S Kᵀ."""
    reading = own.reading
    C, chol_S = reading.C, reading.chol_S
    if options(context)[JOSEPH] != 0.0:
        gain(m, C, chol_S, estimated(context), own.K, reading.W)
        joseph(m, reading.d, C, own.H, own.K, P, own.N, reading.W, reading.B)
    else:
        downdate(m, C, chol_S, estimated(context), P, reading.W)


@by_address
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """x ← x + K ν;  P by the Joseph form, with H = dh/dx at the prediction. Iterated, the update of iekf.py.

    Diverges when h curves strongly within the spread of the prediction: P then shrinks faster than the error.

    With more iterations, xᵢ₊₁ = x̂ + Kᵢ (y - h(xᵢ) - Hᵢ (x̂ - xᵢ)), x₀ = x̂. Each starts from the prediction x̂ and its P,
    so that the measurement counts once; NIS, gate and weight are those of the prediction, P that of the last H. They
    end with a step xᵢ₊₁ - xᵢ of at most `SETTLED` deviations of the prediction.

    Sources: Jazwinski (1970), chapter 8; Bell & Cathey (1993), doi:10.1109/9.250476, for iterations.
    """
    x, P = moments_of(state, context.nx)
    own = updating(start_of(work), context.nx, sensor_rows(context, sensor)[1])
    reading, H = own.reading, own.H
    reading_variances(context, sensor, state, reading.r)
    iterations = int(options(context)[ITERATIONS])
    # N is needed for the Joseph form only, z for the weight at the prediction only.
    predicted, nu, nu_std = own.N[0], innovation, innovation_std
    copy_vector(x, predicted)
    copy_vector(x, own.last)
    verdict = USED
    m = np.int64(0)  # a literal would be a second type, and compile every callee twice
    for iteration in range(iterations):
        linearise(context, sensor, x, u, P, reading, H, own.jacobian)
        m = compare(context, sensor, y, reading, H, P, nu, nu_std)
        if iteration == 0:
            verdict = admit_weighted(context, sensor, m, reading, score)
        else:
            back_to(predicted, m, H, x, reading.nu)
            if factor(reading.S, reading.chol_S, m, x.size):
                solve_transposed(reading.chol_S, m, reading.nu)
            else:
                verdict = FAILED
        if verdict != USED:
            break
        move_mean(m, reading.C, reading.chol_S, reading.nu, estimated(context), x)
        if iterations > 1 and has_settled(P, x, own.last):
            break
        nu, nu_std = reading.z[: reading.r.size], reading.z[reading.r.size :]
    if verdict == USED:
        narrow(context, m, own, P)
        wrap_mean(context, x)
        if is_adaptive(context):
            adapt(context, sensor, y, state, innovation, innovation_std, score)
    return verdict


@inlined
def back_to(predicted, m, H, x, nu):
    """ν ← ν - Hᵢ (x̂ - xᵢ);  xᵢ ← x̂."""
    for k in range(m):
        for j in range(x.size):
            nu[k] -= H[k, j] * (predicted[j] - x[j])
    copy_vector(predicted, x)


@inlined
def has_settled(P, x, last):
    """Return whether x is within `SETTLED` deviations of the prediction from `last`, which it replaces."""
    near = True
    for j in range(x.size):
        near &= abs(x[j] - last[j]) <= SETTLED * np.sqrt(P[j, j])
    copy_vector(x, last)
    return near


EKF = Estimator(
    name="ekf",
    title="Extended Kalman filter",
    family="Gaussian",
    assumes="differentiable f and h, nearly straight within the spread of the estimate",
    model_runs="1 and its derivatives (nx by complex step)",
    fails_when="curvature makes it overconfident, so that it neglects the sensors",
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
    considers=True,
    linearises=True,
    smoothing=SmoothingRule(TANGENT),
    singular=True,
)
