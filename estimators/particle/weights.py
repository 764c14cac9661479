"""Weights: normalised, kept, and particles drawn by them.

The joint log weights of a reading, log w + log p(y | x), stand in the workspace with their sums; here they become the
state's, or children of equal weight.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from ..compiled.context import options as numbers
from ..estimator import Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import address, jit
from ..numerics.vectors import exp_minus
from .cloud import EQUAL, ESS, FRACTION, MEMBERS, RESAMPLED, SCHEME, SETTLED, cloud_of, weigh_equally
from .lineage import count_origins, inherit
from .moments import add_members, finish_moments
from .resampling import STRATIFIED, ancestors_of, drawn_children, strata_children, take_ancestors
from .steps import NO_KEY, add_up, block_of, block_signature, range_of, sweep, work_of

NORMALISE, CHILDREN, COMMIT, OWN = range(4)
"""Places of the phases below among those that `prepare` lays down; a filter's own follow."""


@jit
def normalise_block(context, u, dt, sensor, y, key, value, state, work, number):
    """w = exp(joint - value), and the sums of the cloud's moments, about the reference."""
    n = int(numbers(context)[MEMBERS])
    shared, cloud = work_of(context, work), cloud_of(state, context.nx, n)
    block = block_of(context, shared, number)
    first, last = range_of(number, n)
    w = shared.w[first:last]
    for k in range(block.sums.size):
        block.sums[k] = 0.0
    exp_minus(w.size, shared.joint[first:], value, w)
    add_members(cloud.circular, w, cloud.records[first:last], shared.reference, block.D, block.sums)


@jit
def children_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Children of the members by systematic or stratified resampling; `value` turns a weight into points."""
    n = int(numbers(context)[MEMBERS])
    shared = work_of(context, work)
    first, last = range_of(number, n)
    after = n if last == n else shared.strata[number + 1]
    scheme = int(numbers(context)[SCHEME])
    strata_children(
        scheme, key, shared.w[first:last], shared.strata[number], float(after), value, shared.joint[first:last]
    )


@jit
def commit_block(context, u, dt, sensor, y, key, value, state, work, number):
    """log w = joint - value."""
    n = int(numbers(context)[MEMBERS])
    joint, log_w = work_of(context, work).joint, cloud_of(state, context.nx, n).log_w
    first, last = range_of(number, n)
    for i in range(first, last):
        log_w[i] = joint[i] - value


def phases(*own: Any) -> Callable[[StateSpaceModel, Options], np.ndarray]:
    """`prepare` of a filter with these phases of its own, numbered from `OWN` on: where their machine code starts."""

    @lru_cache(maxsize=1)
    def codes() -> np.ndarray:
        every = (normalise_block, children_block, commit_block, *own)
        return np.array([address(phase, block_signature) for phase in every], np.int64)

    return lambda model, options: codes()


@jit
def normalise(context, state, work):
    """Weights, moments and effective sample size from the joint log weights, whose maximum stands in the sums.

    Returns:
        log Σ exp(joint), the reading's log-likelihood; -inf if no particle explains it.
    """
    nx = context.nx
    shared = work_of(context, work)
    top = shared.sums[2]
    if not top > -np.inf:
        return -np.inf
    heaviest = cloud_of(state, nx, int(numbers(context)[MEMBERS])).records[int(shared.sums[3])]
    for j in range(nx):
        shared.reference[j] = heaviest[j]
    _over_weights(NORMALISE, context, NO_KEY, top, state, work)
    sums = add_up(context, work)
    return top + np.log(sums[0])


@jit
def _over_weights(phase, context, key, value, state, work):
    """A phase that looks at neither inputs nor reading."""
    sweep(phase, context, state, 0.0, 0, state, key, value, state, work)


@jit
def _settle(context, state, work):
    """Mean, covariance and effective sample size, 1 / Σ w², of the weights of `normalise`; a reading has been used.

    Source: Kong, Liu & Wong (1994), Sequential imputations, doi:10.1080/01621459.1994.10476469.
    """
    shared = work_of(context, work)
    sums = shared.sums
    cloud = cloud_of(state, context.nx, int(numbers(context)[MEMBERS]))
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
    """Make mean and covariance of the weights of `normalise` the state's, and the weights, or particles drawn by them.

    They are drawn when the effective sample size has fallen under its part of N.

    Returns:
        Whether they were.
    """
    sums = work_of(context, work).sums
    if sums[0] * sums[0] / sums[1] < numbers(context)[FRACTION] * numbers(context)[MEMBERS]:
        _settle(context, state, work)
        resample(context, key, state, work)
        return True
    keep(context, log_sum, state, work)
    return False


@jit
def children_of(context, key, state, work):
    """Number of children of each particle for the weights of `normalise`, (N,), in the place of the joint weights."""
    n = int(numbers(context)[MEMBERS])
    shared = work_of(context, work)
    whole = shared.sums[0]
    scheme = int(numbers(context)[SCHEME])
    if scheme > STRATIFIED:
        drawn_children(scheme, key, shared.w, whole, shared.joint)
        return shared.joint
    scale = n / whole
    begun = 0.0
    for b in range(shared.strata.size):
        shared.strata[b] = min(begun * scale, float(n))
        begun += block_of(context, shared, b).sums[0]
    _over_weights(CHILDREN, context, key, scale, state, work)
    return shared.joint


@jit
def resample(context, key, state, work):
    """Let each particle of the weights of `normalise` have its children, of equal weight, siblings side by side."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    children = children_of(context, key, state, work)
    ancestors = work_of(context, work).ancestors
    ancestors_of(children, ancestors)
    take_ancestors(ancestors, cloud_of(state, nx, n).records)
    inherit(context, ancestors, state)
    effective = state[ESS]
    weigh_equally(state, nx, n)
    state[ESS] = effective
    state[RESAMPLED] += 1.0
