"""The auxiliary particle filter: choose the particles by how well they foresee the reading, then let them move.

First stage: particle j is chosen in proportion to λ_j = w_j' p̂_j(y), the density of the reading under its predictive
Gaussian N(h(f(x_j)), H P H' + R). Second: x_i ~ p(x | x_j'), w_i ∝ p(y | x_i) / p̂_j(y). The likelihood
Σ_j λ_j · (1/N) Σ_i p(y | x_i) / p̂_j(y) is unbiased for the transition that proposals.py draws from: the model's own
where one step lies between readings, the EKF's Gaussian over several.

Pitt & Shephard score by p(y | f(x_j)) itself, whose tails are lighter than those of p(y | x), so that weights have no
bound; with the predictive spread they have one (Johansen & Doucet).

Sources: Pitt & Shephard (1999), doi:10.1080/01621459.1999.10474153; Johansen & Doucet (2008),
doi:10.1016/j.spl.2008.01.032.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..compiled.context import sensor_variances
from ..compiled.noise import independent_rows, semidefinite_root
from ..estimator import Estimator
from ..numerics.jit import jit, matrix
from ..numerics.random import ONE, key_of, normal
from ..track import FAILED, MISSING, USED
from .cloud import DRAW, MEMBERS, OPTIONS, RESAMPLE, RESAMPLED, cloud_of, own_covariance, sized, tune, weigh_equally
from .describe import describe, moments, peaks, points, recoveries
from .innovation import finite_rows
from .lineage import account, inherit, score_cloud
from .proposals import (
    PROPOSE,
    ahead_of,
    expect_block,
    expected_reading,
    move_block,
    place_draw,
    predict,
    room_of,
    settle_draw,
    work_size,
)
from .recovery import recover, start
from .resampling import ancestors_of, take_ancestors
from .steps import add_up, block_of, range_of, sweep, work_of
from .weights import children_of, keep, normalise, phases


@jit
def propose_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Draw each member from its own N(x, P), that is x + L z, z ~ N(0, I); the weight is p(y | x) / p̂(y).

    p̂ is the predictive density by which the particle was chosen.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    shared, cloud = work_of(context, work), cloud_of(state, nx, n)
    room, sums = room_of(context, shared, number), block_of(context, shared, number).sums
    ahead, L, z = ahead_of(context, shared).densities, room.L, room.z
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
    """Let each particle of the first stage's weights have its children, with the density by which it was chosen."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    shared = work_of(context, work)
    children = children_of(context, key, state, work)
    ancestors_of(children, shared.ancestors)
    take_ancestors(shared.ancestors, cloud_of(state, nx, n).records)
    inherit(context, shared.ancestors, state)
    take_ancestors(shared.ancestors, matrix(ahead_of(context, shared).densities, 0, n, 1))
    weigh_equally(state, nx, n)
    state[RESAMPLED] += 1.0


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Choose by the predictive density, move, weigh by what it got wrong."""
    if finite_rows(y, sensor_variances(context, sensor).size) == 0:
        return MISSING
    index, verdict = expected_reading(context, u, sensor, y, state, work, innovation, innovation_std, score)
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
            score_cloud(state, score)
    score[2] = log_sum if log_sum > -np.inf else np.nan
    if verdict == FAILED or (verdict == USED and not log_sum > -np.inf):
        verdict = FAILED
        recover(context, index, state)
    return verdict


APF = Estimator(
    name="apf",
    title="Auxiliary particle filter",
    family="particle",
    assumes="as pf; h differentiable, the noise of a step Gaussian",
    model_runs="2 N, and the derivatives of h (of f too between readings of several steps)",
    fails_when="the predictive density, linearised, misjudges which particles will explain the reading",
    source="Pitt & Shephard (1999), doi:10.1080/01621459.1999.10474153",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: 2 * options["particles"],
    state_size=sized(lambda nx: nx + nx * nx),
    work_size=work_size,
    moments=moments,
    points=points,
    peaks=peaks,
    recoveries=recoveries,
    account=account,
    options=tuple(option for option in OPTIONS if option.name != "fraction"),
    tune=tune,
    prepare=phases(move_block, expect_block, propose_block),
)
