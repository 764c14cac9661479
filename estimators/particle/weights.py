"""Steps over all particles, block by block, and their weights: normalised, kept, or resampled.

A step is a phase: a function of one block, which `sweep` runs over all of them on one thread or several; the sums that
it leaves in each block are added up in order afterwards. Phases are called through their addresses, which `prepare`
lays down, so each is compiled once and not again into every function that sweeps. Randomness is keyed by the member, so
the bits are the same on any number of threads.

The joint log weights of a measurement, log w + log p(y | x), stand in the workspace with their sums; here they become
the state's, or children of equal weight.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numba import prange, types

from ..compiled.context import context_at, context_type, place_of
from ..compiled.context import options as numbers
from ..estimator import Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import F1, address, caller, f64, i64, ints, jit, matrix
from ..numerics.simd import exp_minus
from ..numerics.workspace import WORD, declare_layout, layout, size_of, start_of, take_matrix
from .cloud import (
    BLOCK,
    CHUNK,
    EQUAL,
    ESS,
    FRACTION,
    RESAMPLED,
    SCHEME,
    SETTLED,
    THREADS,
    add_members,
    clear_sums,
    count_of,
    count_origins,
    finish_moments,
    members,
    own_cloud,
    sums_size,
    weigh_equally,
)
from .resampling import STRATIFIED, ancestors_of, descend, drawn_children, points_below, strata_children

NORMALISE, CHILDREN, COMMIT, OWN = range(4)
"""Places of the phases below among those that `prepare` lays down; a filter's own phases follow."""

NO_KEY = np.uint64(0)
"""For phases that draw nothing."""

block_signature = types.void(context_type, F1, f64, i64, F1, types.uint64, f64, F1, F1, i64)
"""phase(context, u, dt, sensor, y, key, value, state, work, number of the block): each gets all, needed or not."""

call_block = caller(block_signature)


Block, block_at = declare_layout("Block", "nx, ny", sums_size, sums="sums_size(nx, ny)", D=f"max(nx, ny) + 2, {CHUNK}")
"""A block's own scratch: its sums, and the deviations of a chunk of members."""


@layout
def blocks_of(n):
    """Return the number of blocks of n members."""
    return (n + BLOCK - 1) // BLOCK


@layout
def block_size(nx, ny):
    """Return the numbers of a block's scratch."""
    return block_at(0, nx, ny).end // WORD


CloudScratch, work_at = declare_layout(
    "CloudScratch",
    "nx, ny, n",
    sums_size,
    blocks_of,
    block_size,
    ancestors="int n",
    w="n",  # weights
    joint="n",  # joint log weights
    sums="sums_size(nx, ny)",
    L="nx, nx",  # a root
    spare="nx, nx",  # scratch of a root
    S="ny, ny",  # covariance of the predicted measurement
    U="ny, ny",  # its factor
    nu="ny",  # innovation
    reference="nx",  # state from which deviations count
    strata="blocks_of(n)",  # points at which the blocks' strata begin
    blocks="blocks_of(n), block_size(nx, ny)",
)
"""Scratch that all blocks share, and a row for each block. A filter's own follows."""


@jit
def work_of(context, work):
    """Return the shared part of a filter's scratch."""
    return work_at(start_of(work), context.nx, context.width, count_of(context))


@jit
def block_of(context, shared, b):
    """Return the scratch of block b."""
    return block_at(start_of(shared.blocks[b]), context.nx, context.width)


def work_sized(room_at: Callable, own: Callable[[int], int] = lambda nx: 0) -> Callable[[Options, int, int], int]:
    """Return the `work_size` of a filter: the cloud's scratch, `own(nx)` numbers a member, a room for each block."""

    def size(options: Options, nx: int, ny: int) -> int:
        n = members(options)
        return size_of(work_at, nx, ny, n) + n * own(nx) + blocks_of(n) * size_of(room_at, nx, ny)

    return size


@jit
def members_own(context, shared, width):
    """Return the filter's own numbers of each member (N, width), and the address behind them: of the blocks' rooms."""
    return take_matrix(shared.end, count_of(context), width)


@jit
def range_of(b, n):
    """Return the first member of block b, and the one after its last."""
    return b * BLOCK, min(n, (b + 1) * BLOCK)


@jit(parallel=True)
def _on_threads(code, context, u, dt, sensor, y, key, value, state, work, blocks):
    place = place_of(context)
    for b in prange(blocks):
        call_block(code, context_at(place), u, dt, sensor, y, key, value, state, work, b)


@jit
def sweep(phase, context, u, dt, sensor, y, key, value, state, work):
    """Run a phase, given by its place among those of `prepare`, over all blocks."""
    blocks = blocks_of(count_of(context))
    code = ints(context.prepared, context.n_prepared)[phase]
    if numbers(context)[THREADS] != 0.0:
        _on_threads(code, context, u, dt, sensor, y, key, value, state, work, blocks)
    else:
        for b in range(blocks):
            call_block(code, context, u, dt, sensor, y, key, value, state, work, b)


@jit
def add_up(context, work):
    """Add up the blocks' sums of the last phase, in their order; keep the highest maximum with its member."""
    shared = work_of(context, work)
    sums = shared.sums
    clear_sums(sums)
    for b in range(blocks_of(count_of(context))):
        own = block_of(context, shared, b).sums
        for k in range(sums.size):
            if k != 2 and k != 3:
                sums[k] += own[k]
        if own[2] > sums[2]:
            sums[2] = own[2]
            sums[3] = own[3]
    return sums


@jit
def all_lost(context, state, work):
    """Return whether a prediction lost all particles; its blocks' first sums are the numbers of those lost."""
    lost = add_up(context, work)[0]
    if lost > 0.0:
        state[EQUAL] = 0.0
    return lost >= count_of(context)


@jit
def normalise_block(context, u, dt, sensor, y, key, value, state, work, number):
    """w = exp(joint - value), and the sums of the cloud's moments, about the reference."""
    shared, cloud = work_of(context, work), own_cloud(context, state)
    block = block_of(context, shared, number)
    first, last = range_of(number, cloud.log_w.size)
    w = shared.w[first:last]
    clear_sums(block.sums)
    exp_minus(w.size, shared.joint[first:], value, w)
    add_members(cloud.circular, w, cloud.records[first:last], shared.reference, block.D, block.sums)


@jit
def children_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Children of the members by systematic or stratified resampling, and their ancestors.

    `value` turns a weight into points.
    """
    n = count_of(context)
    shared = work_of(context, work)
    first, last = range_of(number, n)
    after = n if last == n else shared.strata[number + 1]
    scheme = int(numbers(context)[SCHEME])
    before, children = shared.strata[number], shared.joint[first:last]
    strata_children(scheme, key, shared.w[first:last], before, float(after), value, children)
    own = shared.ancestors[int(points_below(scheme, key, before)) : int(points_below(scheme, key, float(after)))]
    ancestors_of(children, first, own)


@jit
def commit_block(context, u, dt, sensor, y, key, value, state, work, number):
    """log w = joint - value."""
    joint, log_w = work_of(context, work).joint, own_cloud(context, state).log_w
    first, last = range_of(number, log_w.size)
    for i in range(first, last):
        log_w[i] = joint[i] - value


def phases(*own: Callable) -> Callable[[StateSpaceModel, Options], np.ndarray]:
    """Return `prepare` of a filter with these phases of its own, numbered from `OWN` on: their addresses."""

    @lru_cache(maxsize=1)
    def codes() -> np.ndarray:
        every = (normalise_block, children_block, commit_block, *own)
        return np.array([address(phase, block_signature) for phase in every], np.int64)

    return lambda model, options: codes()


@jit
def normalise(context, state, work):
    """Fill weights, moments and effective sample size from the joint log weights, whose maximum is in the sums.

    Returns:
        log Σ exp(joint), the measurement's log-likelihood; -inf if no particle explains it.
    """
    shared = work_of(context, work)
    top = shared.sums[2]
    if not top > -np.inf:
        return -np.inf
    heaviest = own_cloud(context, state).records[int(shared.sums[3])]
    for j in range(context.nx):
        shared.reference[j] = heaviest[j]
    _over_weights(NORMALISE, context, NO_KEY, top, state, work)
    sums = add_up(context, work)
    return top + np.log(sums[0])


@jit
def _over_weights(phase, context, key, value, state, work):
    """Run a phase that reads neither inputs nor measurement."""
    sweep(phase, context, state, 0.0, 0, state, key, value, state, work)


@jit
def _settle(context, state, work):
    """Fill mean, covariance and effective sample size, 1 / Σ w², of the weights of `normalise`.

    Source: Kong, Liu & Wong (1994), Sequential imputations, doi:10.1080/01621459.1994.10476469.
    """
    shared = work_of(context, work)
    sums = shared.sums
    cloud = own_cloud(context, state)
    finish_moments(cloud.circular, sums, shared.reference, cloud.mean, cloud.cov)
    state[SETTLED] = 1.0
    state[ESS] = sums[0] * sums[0] / sums[1]
    count_origins(context, state)


@jit
def keep(context, log_sum, state, work):
    """Make the weights of `normalise` the state's, with its mean and covariance."""
    _settle(context, state, work)
    _over_weights(COMMIT, context, NO_KEY, log_sum, state, work)
    state[EQUAL] = 0.0


@jit
def keep_or_resample(context, key, log_sum, state, work):
    """Make the moments of the weights of `normalise` the state's, and the weights, or particles drawn by them.

    Particles are drawn when the effective sample size is below its fraction of N.

    Returns:
        Whether they were.
    """
    sums = work_of(context, work).sums
    if sums[0] * sums[0] / sums[1] < numbers(context)[FRACTION] * count_of(context):
        _settle(context, state, work)
        effective = state[ESS]
        resample(context, key, state, work)
        state[ESS] = effective
        return True
    keep(context, log_sum, state, work)
    return False


@jit
def draw_ancestors(context, key, state, work):
    """Draw the parent of each child by the weights of `normalise`; the joint weights are scratch."""
    n = count_of(context)
    shared = work_of(context, work)
    whole = shared.sums[0]
    scheme = int(numbers(context)[SCHEME])
    if scheme > STRATIFIED:
        drawn_children(scheme, key, shared.w, whole, shared.joint)
        ancestors_of(shared.joint, 0, shared.ancestors)
        return
    scale = n / whole
    begun = 0.0
    for b in range(shared.strata.size):
        shared.strata[b] = min(begun * scale, float(n))
        begun += block_of(context, shared, b).sums[0]
    _over_weights(CHILDREN, context, key, scale, state, work)


@jit
def resample(context, key, state, work):
    """Replace the particles by children drawn by the weights of `normalise`, siblings side by side, weights equal."""
    draw_ancestors(context, key, state, work)
    cloud = own_cloud(context, state)
    lineage = matrix(cloud.lineage, 0, cloud.lineage.size, 1)
    descend(work_of(context, work).ancestors, cloud.records, lineage, numbers(context)[THREADS] != 0.0)
    weigh_equally(context, state)
    state[RESAMPLED] += 1.0
