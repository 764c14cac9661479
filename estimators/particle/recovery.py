"""Clouds drawn from a Gaussian: at the start, and to widen one in which no particle explains a reading."""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_states
from ..compiled.context import options as numbers
from ..compiled.noise import add_noise, belief_root
from ..numerics.jit import floats, jit, matrix
from ..numerics.random import key_of, normal
from .cloud import HEAD, MEMBERS, RECOVER, RECOVERIES, SETTLED, START, cloud_of, weigh_equally, wrap_record
from .lineage import begin_lineage
from .mode_draws import any_mode, jump_key, nearest_mode
from .moments import cloud_moments


@jit
def scatter(context, mean, root, key, records):
    """Draw every particle from N(mean, L Lᵀ), certain of itself."""
    nx = mean.size
    circular = circular_states(context)
    z = np.empty(nx)
    mode = context.mode
    variance = 0.0
    for k in range(mode + 1):
        variance += root[mode, k] * root[mode, k]
    for i in range(records.shape[0]):
        for j in range(nx):
            z[j] = normal(key, np.uint64(i * nx + j))
            records[i, j] = mean[j]
        for j in range(nx, records.shape[1]):
            records[i, j] = 0.0
        add_noise(root, z, records[i, :nx])
        if mode >= 0:
            records[i, mode] = nearest_mode(context, records[i, mode], mean[mode], np.sqrt(variance))
        wrap_record(circular, records[i])


@jit
def restart(context, mean, cov, index, stream, state):
    """A cloud drawn from N(mean, cov), of equal weights; the head's counters stay."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    root = np.empty((nx, nx))
    belief_root(cov, root)
    scatter(context, mean, root, key_of(context.seed, index, stream), cloud_of(state, nx, n).records)
    weigh_equally(state, nx, n)
    begin_lineage(context, state)
    state[SETTLED] = 0.0


@jit
def start(context, mean, cov, state):
    """The cloud that stands for N(mean, cov): drawn from it, the same whenever the filter starts."""
    nx = context.nx
    circular = circular_states(context)
    for i in range(HEAD):
        state[i] = 0.0
    cloud = cloud_of(state, nx, int(numbers(context)[MEMBERS]))
    for j in range(nx):
        cloud.circular[j] = circular[j]
    restart(context, mean, cov, 0, START, state)


SEED = 1e-6
"""Part of the prior's variances from which a cloud without any spread widens."""


@jit
def recover(context, index, state):
    """Widen a cloud in which no particle explains the reading: each moves by a draw from the cloud's own covariance.

    The covariance doubles with every such reading, until particles reach what the sensors say; copies of one particle
    begin at the part `SEED` of the prior's; each takes any mode. A cloud without any weight left, all its particles
    beyond the floating-point numbers, starts again from the prior.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    state[RECOVERIES] += 1.0
    records = cloud_of(state, nx, n).records
    mean = np.empty(nx)
    cov = np.empty((nx, nx))
    cloud_moments(state, nx, n, mean, cov)
    prior = matrix(floats(context.prior_cov, nx * nx), 0, nx, nx)
    finite = True
    for i in range(nx):
        finite = finite and np.isfinite(mean[i]) and np.isfinite(cov[i, i])
        cov[i, i] = max(cov[i, i], SEED * prior[i, i])
    if not finite:
        restart(context, floats(context.prior_mean, nx), prior, index, RECOVER, state)
        return
    root = np.empty((nx, nx))
    belief_root(cov, root)
    key = key_of(context.seed, index, RECOVER)
    spread_by(context, root, key, 0, records)
    if context.mode >= 0:
        for i in range(n):
            records[i, context.mode] = any_mode(context, jump_key(key), i)
    begin_lineage(context, state)
    state[SETTLED] = 0.0


@jit
def spread_by(context, root, key, first, records):
    """Move each particle by L z, z ~ N(0, I), but for its mode; `first` is the member of the first record."""
    nx = root.shape[0]
    mode = context.mode
    kept = 0.0
    circular = circular_states(context)
    z = np.empty(nx)
    for i in range(records.shape[0]):
        for j in range(nx):
            z[j] = normal(key, np.uint64((first + i) * nx + j))
        if mode >= 0:
            kept = records[i, mode]
        add_noise(root, z, records[i, :nx])
        if mode >= 0:
            records[i, mode] = kept
        wrap_record(circular, records[i])
