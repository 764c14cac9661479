"""Random draws of whole clouds, at the start and to recover a lost one, and of a discrete mode (model/jump.py)."""

from __future__ import annotations

import math

import numpy as np

from ..compiled.context import circular_states, estimated, jump_chances
from ..compiled.noise import add_noise, belief_root, lost_root
from ..numerics.jit import floats, jit, matrix
from ..numerics.random import GAMMA, fill_normals, key_of, mix, unit, word
from .cloud import (
    CONSIDER,
    HEAD,
    RECOVER,
    RECOVERIES,
    SETTLED,
    START,
    begin_lineage,
    cloud_moments,
    count_of,
    own_cloud,
    weigh_equally,
    wrap_record,
)

_JUMP = np.uint64(0x9FB21C651E98DF25)
"""Separates the words of the jumps from the noise of the same key."""


@jit
def jump_key(key):
    """Return the key of the jumps that go with the noise of `key`."""
    return mix((key ^ _JUMP) + GAMMA)


@jit
def jump(context, x, u, dt, key, member, chances):
    """Let the mode of one particle x jump, by word `member` of a `jump_key`; `chances` (n_modes,) is scratch.

    The mode stays where the chances are not numbers.
    """
    jump_chances(context, x, u, dt, chances)
    total = 0.0
    for k in range(chances.size):
        total += chances[k]
    if not 0.0 < total < np.inf:
        return
    left = unit(word(key, np.uint64(member))) * total
    mode = 0
    while mode < chances.size - 1 and left >= chances[mode]:
        left -= chances[mode]
        mode += 1
    x[context.mode] = mode


@jit
def nearest_mode(context, value, mean, std):
    """Return the mode for a draw `value` of N(mean, std²), so that modes have the probabilities of a prior.

    With two modes the second has the probability `mean`; with more, mode k has a probability proportional to
    exp(-½ (k - mean)²/std²), and the quantile of `value` picks.
    """
    place = 0.5 * math.erfc(-(value - mean) / (math.sqrt(2.0) * max(std, 1e-12)))
    last = context.n_modes - 1
    if last == 1:
        return 1.0 if place > 1.0 - mean else 0.0
    total = 0.0
    for k in range(last + 1):
        total += math.exp(-0.5 * ((k - mean) / max(std, 0.1)) ** 2)
    left = place * total
    mode = 0
    while mode < last:
        left -= math.exp(-0.5 * ((mode - mean) / max(std, 0.1)) ** 2)
        if left < 0.0:
            break
        mode += 1
    return float(mode)


@jit
def any_mode(context, key, member):
    """Return a mode at random, all equally likely."""
    return float(min(int(unit(word(key, np.uint64(member))) * context.n_modes), context.n_modes - 1))


@jit
def reset(context, mean, state):
    """Clear the head of a state, and fill the mask of circular states."""
    circular = circular_states(context)
    state[:HEAD] = 0.0
    cloud = own_cloud(context, state)
    for j in range(mean.size):
        cloud.circular[j] = circular[j]


@jit
def scatter(context, mean, root, key, records):
    """Draw every particle from N(mean, L Lᵀ), without a covariance of its own."""
    nx = mean.size
    circular = circular_states(context)
    z = np.empty(nx)
    mode = context.mode
    variance = 0.0
    for k in range(mode + 1):
        variance += root[mode, k] * root[mode, k]
    for i in range(records.shape[0]):
        fill_normals(key, np.uint64(i * nx), nx, z)
        for j in range(nx):
            records[i, j] = mean[j]
        records[i, nx:] = 0.0
        add_noise(root, z, records[i, :nx])
        if mode >= 0:
            records[i, mode] = nearest_mode(context, records[i, mode], mean[mode], np.sqrt(variance))
        wrap_record(circular, records[i])


@jit
def restart(context, mean, cov, index, stream, state):
    """Draw a cloud of equal weights from N(mean, cov); the head's counters stay."""
    root = np.empty((context.nx, context.nx))
    belief_root(cov, root)
    scatter(context, mean, root, key_of(context.seed, index, stream), own_cloud(context, state).records)
    weigh_equally(context, state)
    begin_lineage(context, state)
    state[SETTLED] = 0.0


@jit
def start(context, mean, cov, state):
    """Draw the cloud that stands for N(mean, cov); the same whenever the filter starts."""
    reset(context, mean, state)
    restart(context, mean, cov, 0, START, state)


@jit
def spread_by(context, root, key, first, records):
    """Move each particle by L z, z ~ N(0, I), but for its mode; `first` is the member of the first record."""
    nx = root.shape[0]
    mode = context.mode
    kept = 0.0
    circular = circular_states(context)
    z = np.empty(nx)
    for i in range(records.shape[0]):
        fill_normals(key, np.uint64((first + i) * nx), nx, z)
        if mode >= 0:
            kept = records[i, mode]
        add_noise(root, z, records[i, :nx])
        if mode >= 0:
            records[i, mode] = kept
        wrap_record(circular, records[i])


@jit
def reconsider(context, index, state):
    """Give considered states c the mean and covariance of their prior again, after a measurement that weighed them.

    c ← c - c̄ + c₀ + L z, z ~ N(0, I), with L Lᵀ = C - P_cc, the variance that the measurement took. As z is independent
    of everything, mean and covariance of the other states, and their covariance with c, stay those of the weighted
    cloud: for a linear model they are those of Schmidt's filter (gaussian/shared.py). Particles that kept their c
    would lose the prior's spread with their weights; a filter for each c, mixed by the prior alone, would have no gain
    that falls where measurements determine c better.

    Sources: Schmidt (1966), for the moments; Liu & West (2001), doi:10.1007/978-1-4757-3437-9_10, for draws that
    restore the moments of constant states.
    """
    first, nx = estimated(context), context.nx
    count = nx - first
    if count == 0:
        return
    cloud = own_cloud(context, state)
    mean = floats(context.prior_mean, nx)
    root = np.zeros((count, count))
    if not lost_root(context, first, cloud.cov[first:, first:], root):
        return
    key = key_of(context.seed, index, CONSIDER)
    z = np.empty(count)
    for member in range(cloud.records.shape[0]):
        fill_normals(key, np.uint64(member * count), count, z)
        for i in range(count):
            moved = mean[first + i] - cloud.mean[first + i]
            for k in range(count):
                moved += root[i, k] * z[k]
            cloud.records[member, first + i] += moved
    for i in range(count):
        cloud.mean[first + i] = mean[first + i]
        for j in range(count):
            for k in range(count):
                cloud.cov[first + i, first + j] += root[i, k] * root[j, k]


@jit
def lost_moments(context, state, mean, cov):
    """Count a recovery; fill mean and covariance of the lost cloud; return whether they are finite."""
    state[RECOVERIES] += 1.0
    cloud_moments(state, context.nx, count_of(context), mean, cov)
    finite = True
    for i in range(mean.size):
        finite = finite and np.isfinite(mean[i]) and np.isfinite(cov[i, i])
    return finite


SEED_VARIANCE = 1e-6
"""Share of the prior's variances from which a cloud without any spread widens."""


@jit
def recover(context, index, state):
    """Widen a cloud in which no particle explains the measurement: each moves by a draw from the cloud's covariance.

    The covariance doubles with every such measurement, until particles reach the measurements; copies of one particle
    begin at the share `SEED_VARIANCE` of the prior's; each takes any mode. A cloud without any weight left, with all
    particles infinite or NaN, starts again from the prior.
    """
    nx = context.nx
    records = own_cloud(context, state).records
    mean, cov = np.empty(nx), np.empty((nx, nx))
    finite = lost_moments(context, state, mean, cov)
    prior = matrix(floats(context.prior_cov, nx * nx), 0, nx, nx)
    if not finite:
        restart(context, floats(context.prior_mean, nx), prior, index, RECOVER, state)
        return
    for i in range(nx):
        cov[i, i] = max(cov[i, i], SEED_VARIANCE * prior[i, i])
    root = np.empty((nx, nx))
    belief_root(cov, root)
    root[estimated(context) :] = 0.0
    key = key_of(context.seed, index, RECOVER)
    spread_by(context, root, key, 0, records)
    if context.mode >= 0:
        for i in range(records.shape[0]):
            records[i, context.mode] = any_mode(context, jump_key(key), i)
    begin_lineage(context, state)
    state[SETTLED] = 0.0
