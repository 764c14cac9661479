"""The auxiliary particle filter: choose the particles by how well they predict the measurement, then move them.

First stage: particle j is chosen in proportion to λ_j = w_j' p̂_j(y), the density of the measurement under its
predictive Gaussian N(h(f(x_j)), H P H' + R). Second: x_i ~ p(x | x_j'), w_i ∝ p(y | x_i) / p̂_j(y). The likelihood
Σ_j λ_j · (1/N) Σ_i p(y | x_i) / p̂_j(y) is unbiased for the transition that proposals.py draws from: the model's own
where one step lies between measurements, the EKF's Gaussian over several.

Pitt & Shephard score by p(y | f(x_j)) itself, whose tails are lighter than those of p(y | x), so that weights have no
bound; with the predictive spread they have one (Johansen & Doucet).

Sources: Pitt & Shephard (1999), doi:10.1080/01621459.1999.10474153; Johansen & Doucet (2008),
doi:10.1016/j.spl.2008.01.032.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import sensor_variances
from ..compiled.noise import independent_rows, semidefinite_root
from ..estimator import Estimator
from ..numerics.jit import jit
from ..numerics.random import ONE, key_of, normal
from ..track import FAILED, GATED, MISSING, USED
from .cloud import DRAW, OPTIONS, RESAMPLE, count_of, describe, own_cloud, own_covariance, score_cloud
from .draws import reconsider, recover, start
from .innovation import expected_reading, finite_rows
from .proposals import (
    EXPECT,
    PROPOSE,
    WAITING,
    densities_of,
    expect_block,
    move_block,
    place_draw,
    predict,
    room_of,
    settle_draw,
)
from .resampling import take_ancestors
from .weights import add_up, block_of, keep, members_own, normalise, phases, range_of, resample, sweep, work_of


@jit
def propose_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Draw each member from its own N(x, P), that is x + L z, z ~ N(0, I); the weight is p(y | x) / p̂(y).

    p̂ is the predictive density by which the particle was chosen.
    """
    nx, n = context.nx, count_of(context)
    shared, cloud = work_of(context, work), own_cloud(context, state)
    room, sums = room_of(context, shared, number), block_of(context, shared, number).sums
    ahead, L, z = densities_of(context, shared), room.L, room.z
    G, d, seen = room.G, room.d, room.seen
    independent_rows(context, sensor, y, sensor_variances(context, sensor), G, d)
    records, log_w, joints = cloud.records, cloud.log_w, shared.joint
    first, last = range_of(number, n)
    place = np.uint64(first) * np.uint64(nx)
    sums[2] = -np.inf
    for i in range(first, last):
        x, P = records[i, :nx], own_covariance(records[i], nx)
        semidefinite_root(P, L)
        sound = True
        for a in range(nx):
            z[a] = normal(key, place)
            place += ONE
            sound &= np.isfinite(z[a])
        joint = -np.inf
        if sound:
            joint = place_draw(context, sensor, u, y, x, L, z, G, d, seen)
            joint += log_w[i] - ahead[i]
        settle_draw(P, joint, i, joints, sums)


@jit
def choose(context, key, state, work):
    """Resample by the weights of the first stage; each child takes along the density that chose its parent."""
    resample(context, key, state, work)
    shared = work_of(context, work)
    densities, _ = members_own(context, shared, 1)
    take_ancestors(shared.ancestors, densities)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Choose by the predictive density, move, and weigh by the ratio of the density to its prediction."""
    if finite_rows(y, sensor_variances(context, sensor).size) == 0:
        return MISSING
    index, verdict = expected_reading(EXPECT, context, u, sensor, y, state, work, innovation, innovation_std, score)
    # First stage: λ_j = w_j p̂_j(y), the log weights that `expected_reading` left
    log_sum = normalise(context, state, work)
    if verdict == USED and log_sum > -np.inf:
        choose(context, key_of(context.seed, index, RESAMPLE), state, work)
        # Second: x_i ~ p(x | x_j'), w_i = p(y | x_i) / p̂_j(y)
        sweep(PROPOSE, context, u, 0.0, sensor, y, key_of(context.seed, index, DRAW), 0.0, state, work)
        add_up(context, work)
        second = normalise(context, state, work)
        log_sum += second
        if log_sum > -np.inf:
            keep(context, second, state, work)
            reconsider(context, index, state)
            score_cloud(state, score)
    if verdict != GATED:
        score[2] = log_sum if log_sum > -np.inf else np.nan
    if verdict == FAILED or (verdict == USED and not log_sum > -np.inf):
        verdict = FAILED
        recover(context, index, state)
    return verdict


APF = Estimator(
    name="apf",
    title="Auxiliary particle filter",
    assumes="as pf; h differentiable, the noise of a step Gaussian",
    model_runs="2 N, and the derivatives of h (of f too between readings of several steps)",
    fails_when="the predictive density, linearised, misjudges which particles will explain the reading",
    source="Pitt & Shephard (1999), doi:10.1080/01621459.1999.10474153",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: 2 * options["particles"],
    prepare=phases(move_block, expect_block, propose_block),
    considers=True,
    **(WAITING | {"options": tuple(option for option in OPTIONS if option.name != "fraction")}),
)
