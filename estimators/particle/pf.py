"""The bootstrap particle filter, and the regularised one: particles move by the model and are weighed by the reading.

x_i ~ p(x | x_i'),  w_i ∝ w_i' p(y | x_i); resampled when the effective sample size is low. NIS is that of the weighted
mean and covariance of h(x_i), so it means the same as a Gaussian filter's; the log-likelihood is that of the particles,
log Σ w_i' p(y | x_i), whose exponential, multiplied up over the readings, is unbiased.

Regularised: after resampling each particle moves by a draw from a Gaussian kernel, h times the cloud's covariance
root, with the bandwidth h that is best for a Gaussian cloud, times the option `bandwidth`. Or only those move that have
a sibling, so that a particle that stayed alone is not disturbed.

Sources: Gordon, Salmond & Smith (1993), doi:10.1049/ip-f-2.1993.0015; Musso, Oudjane & Le Gland (2001), Improving
regularised particle filters, in Sequential Monte Carlo Methods in Practice, doi:10.1007/978-1-4757-3437-9_12.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_rows, sensor_variances
from ..compiled.context import options as numbers
from ..compiled.noise import belief_root, noise_root
from ..estimator import Estimator, Option, Options
from ..gaussian.shared import admit
from ..model.state_space import StateSpaceModel
from ..numerics.jit import jit, matrix
from ..numerics.linalg import wrap
from ..numerics.random import key_of
from ..track import FAILED, MISSING, USED
from ..tuning import Tuning
from .shared import (
    DUPLICATES,
    EQUAL,
    EXTRA,
    JITTER,
    MEMBERS,
    OPTIONS,
    PROCESS,
    RESAMPLE,
    SETTLED,
    block,
    describe,
    modes,
    moments,
    next_draw,
    points,
    records_of,
    recover,
    recoveries,
    settled_moments,
    sized,
    start,
)
from .steps import JITTER as MOVE
from .steps import PROPAGATE, WEIGH, first_residual, keep_or_resample, normalise, shared, sweep, total, tune, work_size


@jit
def predict(context, u, dt, index, state, work):
    """x_i ← f(x_i) + w_i, w_i ~ N(0, Q). Source: Gordon, Salmond & Smith (1993)."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    index = next_draw(state)
    sums, L, spare, _, _, _, _ = shared(context, work, n)
    if context.Q_varies == 0:
        noise_root(context, records_of(state, nx, n)[0], u, dt, L, spare)
    sweep(PROPAGATE, context, u, dt, 0, u, key_of(context.seed, index, PROCESS), 0.0, state, work)
    total(context, work, sums)
    if sums[0] > 0.0:
        state[EQUAL] = 0.0
        if sums[0] >= n:
            recover(context, index, state)


@jit
def finite_rows(y, rows):
    """How many of the reading's rows are there."""
    m = 0
    for row in range(rows):
        if np.isfinite(y[row]):
            m += 1
    return m


@jit
def predicted(context, u, sensor, y, x, sums, S, nu, innovation, innovation_std):
    """Innovation and its covariance from the sums of `weigh`; S and ν hold the finite rows, x is the first particle.

    Returns:
        The number of finite rows.
    """
    r = sensor_variances(context, sensor)
    circular = circular_rows(context, sensor)
    m = finite_rows(y, r.size)
    first_residual(context, u, sensor, y, x, innovation[: r.size])
    k = 0
    for row in range(r.size):
        if not np.isfinite(y[row]):
            innovation[row] = np.nan
            continue
        nu[k] = sums[4 + k] / sums[0]
        for j in range(k + 1):
            S[k, j] = sums[4 + m + k * m + j] / sums[0] - nu[k] * nu[j]
            S[j, k] = S[k, j]
        S[k, k] = max(S[k, k], 0.0) + r[row]
        innovation[row] += nu[k]
        if circular[row] != 0:
            innovation[row] = wrap(innovation[row])
        innovation_std[row] = np.sqrt(S[k, k])
        k += 1
    k = 0
    for row in range(r.size):
        if np.isfinite(y[row]):
            nu[k] = innovation[row]
            k += 1
    return m


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """w_i ← w_i p(y | x_i), and resampling where few particles carry the weight.

    When no particle explains the reading, the verdict is `FAILED`, the reading is not used, and the cloud is widened
    (see `recover`).
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    sums, L, _, S_flat, U_flat, nu, _ = shared(context, work, n)
    rows = sensor_variances(context, sensor).size
    if finite_rows(y, rows) == 0:
        return MISSING
    settled = state[SETTLED]
    index = next_draw(state)
    sweep(WEIGH, context, u, 0.0, sensor, y, np.uint64(0), 0.0, state, work)
    total(context, work, sums)
    S = matrix(S_flat, 0, rows, rows)
    U = matrix(U_flat, 0, rows, rows)
    x = records_of(state, nx, n)[0]
    m = predicted(context, u, sensor, y, x, sums, S, nu, innovation, innovation_std)
    verdict = admit(context, sensor, m, nu, S, U, score)
    state[SETTLED] = settled
    log_sum = normalise(context, u, sensor, y, state, work, sums)
    score[2] = log_sum
    if verdict == USED and log_sum > -np.inf:
        key = key_of(context.seed, index, RESAMPLE)
        drawn = keep_or_resample(context, u, sensor, y, key, log_sum, sums, state, work)
        if drawn and numbers(context)[EXTRA] > 0.0:
            _, cov = settled_moments(state, nx)
            belief_root(cov, L)
            for i in range(nx):
                for j in range(nx):
                    L[i, j] *= numbers(context)[EXTRA]
            sweep(MOVE, context, u, 0.0, sensor, y, key_of(context.seed, index, JITTER), 0.0, state, work)
    elif verdict == USED or verdict == FAILED:
        verdict = FAILED
        recover(context, index, state)
    if not score[2] > -np.inf:
        score[2] = np.nan
    return verdict


BANDWIDTH = Option("bandwidth", 0.5, 0.0, 100.0, "", "kernel width as a part of the best for a Gaussian cloud")

JITTERED = Option.choice(
    "jitter", ("all", "duplicates"), "particles that the kernel moves: all, or those with a sibling"
)


def tune_regularised(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The numbers of the bootstrap filter, and the kernel's width h.

    h = bandwidth · (4 / (nx + 2))^(1/(nx+4)) · N^(-1/(nx+4)): Musso, Oudjane & Le Gland (2001), Gaussian kernel.
    """
    nx = model.nx
    values = tune(options, model, tuning)
    power = 1.0 / (nx + 4)
    values[EXTRA] = options["bandwidth"] * (4.0 / (nx + 2)) ** power * values[MEMBERS] ** -power
    values[DUPLICATES] = options["jitter"]
    return values


PF = Estimator(
    name="pf",
    title="Bootstrap particle filter",
    family="particle",
    assumes="nothing but noise that can be drawn and readings that can be scored",
    model_runs="N",
    fails_when="the readings are much sharper than the cloud, or nx is large: few particles carry all the weight",
    source="Gordon, Salmond & Smith (1993), doi:10.1049/ip-f-2.1993.0015",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["particles"],
    state_size=sized(lambda nx: nx),
    work_size=work_size,
    moments=moments,
    points=points,
    modes=modes,
    recoveries=recoveries,
    options=OPTIONS,
    blocks=block,
    tune=tune,
)

PF_REG = Estimator(
    name="pf-reg",
    title="Regularised particle filter",
    family="particle",
    assumes="as pf, and a posterior with a density: little process noise is no obstacle",
    model_runs="N",
    fails_when="the posterior has sharp structure that the kernel smears",
    source="Musso, Oudjane & Le Gland (2001), doi:10.1007/978-1-4757-3437-9_12",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["particles"],
    state_size=sized(lambda nx: nx),
    work_size=work_size,
    moments=moments,
    points=points,
    modes=modes,
    recoveries=recoveries,
    options=(*OPTIONS, BANDWIDTH, JITTERED),
    blocks=block,
    tune=tune_regularised,
)
