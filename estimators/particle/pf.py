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

from ..compiled.context import options as numbers
from ..compiled.context import sensor_variances
from ..compiled.noise import belief_root, noise_root
from ..estimator import Estimator, Option, Options
from ..gaussian.shared import admit
from ..model.state_space import StateSpaceModel
from ..numerics.jit import jit
from ..numerics.random import key_of
from ..track import FAILED, MISSING, USED
from ..tuning import Tuning
from .cloud import (
    DUPLICATES,
    EQUAL,
    JITTER,
    MEMBERS,
    OPTIONS,
    PROCESS,
    RESAMPLE,
    SETTLED,
    WIDTH,
    block,
    cloud_of,
    next_draw,
    sized,
    tune,
)
from .describe import describe, moments, peaks, points, recoveries
from .innovation import finite_rows, predicted, score_rows
from .lineage import account, score_cloud
from .propagate import propagate_block, smooth_block, work_size
from .recovery import recover, start
from .steps import NO_KEY, add_up, sweep, work_of
from .weigh import weigh_block
from .weights import OWN, keep_or_resample, normalise, phases

PROPAGATE, WEIGH, SMOOTH = range(OWN, OWN + 3)
"""Phases of its own: x_i ~ p(x | x_i'); p(y | x_i); the kernel of the regularised filter."""


@jit
def predict(context, u, dt, index, state, work):
    """x_i ← f(x_i) + w_i, w_i ~ N(0, Q). Source: Gordon, Salmond & Smith (1993)."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    index = next_draw(state)
    shared = work_of(context, work)
    if context.Q_varies == 0:
        noise_root(context, cloud_of(state, nx, n).records[0], u, dt, shared.L, shared.spare)
    sweep(PROPAGATE, context, u, dt, 0, u, key_of(context.seed, index, PROCESS), 0.0, state, work)
    lost = add_up(context, work)[0]
    if lost > 0.0:
        state[EQUAL] = 0.0
        if lost >= n:
            recover(context, index, state)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """w_i ← w_i p(y | x_i), and resampling where few particles carry the weight.

    When no particle explains the reading, the verdict is `FAILED`, the reading is not used, and the cloud is widened
    (see `recover`).
    """
    if finite_rows(y, sensor_variances(context, sensor).size) == 0:
        return MISSING
    shared, cloud = work_of(context, work), cloud_of(state, context.nx, int(numbers(context)[MEMBERS]))
    settled = state[SETTLED]
    index = next_draw(state)
    # log w_i + log p(y | x_i), and ν = y - Σ w h(x), S = Σ w (h(x) - ȳ)(h(x) - ȳ)ᵀ + R for the gate
    sweep(WEIGH, context, u, 0.0, sensor, y, NO_KEY, 0.0, state, work)
    add_up(context, work)
    m = predicted(context, u, sensor, y, cloud.records[0], shared, innovation, innovation_std)
    verdict = admit(context, sensor, m, shared.nu, shared.S, shared.U, score)
    score_rows(context, sensor, y, shared, score)
    state[SETTLED] = settled
    # w_i ← w_i p(y | x_i) / Σ w p(y | x), and log p(y) = log Σ w p(y | x)
    log_sum = normalise(context, state, work)
    score[2] = log_sum
    if verdict == USED and log_sum > -np.inf:
        drawn = keep_or_resample(context, key_of(context.seed, index, RESAMPLE), log_sum, state, work)
        if drawn and numbers(context)[WIDTH] > 0.0:
            smooth(context, key_of(context.seed, index, JITTER), cloud.cov, shared.L, state, work)
        score_cloud(state, score)
    elif verdict == USED or verdict == FAILED:
        verdict = FAILED
        recover(context, index, state)
    if not score[2] > -np.inf:
        score[2] = np.nan
    return verdict


@jit
def smooth(context, key, cov, L, state, work):
    """Move each particle by a draw from the kernel, whose root L is h times that of the cloud's covariance."""
    belief_root(cov, L)
    for i in range(L.shape[0]):
        for j in range(L.shape[0]):
            L[i, j] *= numbers(context)[WIDTH]
    sweep(SMOOTH, context, state, 0.0, 0, state, key, 0.0, state, work)


prepare = phases(propagate_block, weigh_block, smooth_block)

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
    values[DUPLICATES] = options["jitter"]
    values[WIDTH] = options["bandwidth"] * (4.0 / (nx + 2)) ** power * values[MEMBERS] ** -power
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
    peaks=peaks,
    recoveries=recoveries,
    account=account,
    options=OPTIONS,
    blocks=block,
    tune=tune,
    prepare=prepare,
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
    peaks=peaks,
    recoveries=recoveries,
    account=account,
    options=(*OPTIONS, BANDWIDTH, JITTERED),
    blocks=block,
    tune=tune_regularised,
    prepare=prepare,
)
