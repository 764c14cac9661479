"""A step over all particles, block by block, on one thread or several.

A step is a phase: a function of one block, which `sweep` runs over all of them; what it leaves in each block's sums is
added up in order afterwards. Phases are called through their addresses, which `prepare` lays down: so each is compiled
once, not again into every function that sweeps. Randomness goes by the member, so the bits are the same on any number
of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange, types

from ..compiled.context import context_at, context_type, place_of
from ..compiled.context import options as numbers
from ..numerics.jit import F1, caller, f64, i64, ints, jit
from ..numerics.workspace import layout, start_of, take_integers, take_matrix, take_vector
from .cloud import MEMBERS, THREADS
from .moments import BLOCK, CHUNK, sums_size

NO_KEY = np.uint64(0)
"""For phases that draw nothing."""

block_signature = types.void(context_type, F1, f64, i64, F1, types.uint64, f64, F1, F1, i64)
"""phase(context, u, dt, sensor, y, key, value, state, work, number of the block): each is given all, needed or not."""

call_block = caller(block_signature)


class Work(NamedTuple):
    """What all blocks share: weights w (N,), joint log weights (N,), and of the step what the filter makes of the sums.

    `ancestors` (N,), int64s, take the place of the weights once particles are drawn by these. The others are the sums,
    a root L (nx, nx) and room for it, the covariance S of the predicted reading and its factor U (ny, ny), the
    innovation nu (ny,), the state from which deviations count (nx,), and the points at which the blocks' strata begin.
    `blocks` is where the blocks' own parts start.
    """

    w: Any
    ancestors: Any
    joint: Any
    sums: Any
    L: Any
    spare: Any
    S: Any
    U: Any
    nu: Any
    reference: Any
    strata: Any
    blocks: int
    end: int


class Block(NamedTuple):
    """A block's own: its sums, and the deviations of a chunk of members (max(nx, ny) + 2, CHUNK)."""

    sums: Any
    D: Any
    end: int


@layout
def block_at(at, nx, ny):
    """Lay a block's part out."""
    sums, at = take_vector(at, sums_size(nx, ny))
    D, at = take_matrix(at, max(nx, ny) + 2, CHUNK)
    return Block(sums, D, at)


@layout
def blocks_of(n):
    """Blocks that n members make."""
    return (n + BLOCK - 1) // BLOCK


@layout
def work_at(at, nx, ny, n):
    """Lay the scratch of a cloud out; a filter's own follows."""
    ancestors, _ = take_integers(at, n)
    w, at = take_vector(at, n)
    joint, at = take_vector(at, n)
    sums, at = take_vector(at, sums_size(nx, ny))
    L, at = take_matrix(at, nx, nx)
    spare, at = take_matrix(at, nx, nx)
    S, at = take_matrix(at, ny, ny)
    U, at = take_matrix(at, ny, ny)
    nu, at = take_vector(at, ny)
    reference, at = take_vector(at, nx)
    strata, at = take_vector(at, blocks_of(n))
    end = at + blocks_of(n) * block_at(0, nx, ny).end
    return Work(w, ancestors, joint, sums, L, spare, S, U, nu, reference, strata, at, end)


@jit
def work_of(context, work):
    """The shared part of a filter's scratch."""
    return work_at(start_of(work), context.nx, context.width, int(numbers(context)[MEMBERS]))


@jit
def block_of(context, shared, b):
    """The part of block b."""
    nx, ny = context.nx, context.width
    return block_at(shared.blocks + b * block_at(0, nx, ny).end, nx, ny)


@jit
def range_of(b, n):
    """First member of block b, and the one after its last."""
    return b * BLOCK, min(n, (b + 1) * BLOCK)


@jit(parallel=True)
def _on_threads(code, context, u, dt, sensor, y, key, value, state, work, blocks):
    place = place_of(context)
    for b in prange(blocks):
        call_block(code, context_at(place), u, dt, sensor, y, key, value, state, work, b)


@jit
def sweep(phase, context, u, dt, sensor, y, key, value, state, work):
    """Run a phase, by its place among those of `prepare`, over all blocks."""
    blocks = blocks_of(int(numbers(context)[MEMBERS]))
    code = ints(context.prepared, context.n_prepared)[phase]
    if numbers(context)[THREADS] != 0.0:
        _on_threads(code, context, u, dt, sensor, y, key, value, state, work, blocks)
    else:
        for b in range(blocks):
            call_block(code, context, u, dt, sensor, y, key, value, state, work, b)


@jit
def add_up(context, work):
    """Add up what the last phase left in the blocks, in their order; keep the highest maximum with its member."""
    shared = work_of(context, work)
    sums = shared.sums
    for k in range(sums.size):
        sums[k] = 0.0
    sums[2] = -np.inf
    for b in range(blocks_of(int(numbers(context)[MEMBERS]))):
        own = block_of(context, shared, b).sums
        for k in range(sums.size):
            if k != 2 and k != 3:
                sums[k] += own[k]
        if own[2] > sums[2]:
            sums[2] = own[2]
            sums[3] = own[3]
    return sums
