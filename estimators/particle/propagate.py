"""Particles move as the model says: x_i ~ p(x | x_i'), and by the kernel of the regularised filter."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..compiled.context import circular_states, transition_points
from ..compiled.context import options as numbers
from ..compiled.noise import add_noise, noise_root
from ..estimator import Options
from ..numerics.jit import ints, jit
from ..numerics.random import fill_normals
from ..numerics.vectors import all_finite
from ..numerics.workspace import layout, size_of, take_matrix, take_vector
from .cloud import DUPLICATES, MEMBERS, cloud_of, members, wrap_record
from .mode_draws import jump, jump_key
from .moments import CHUNK
from .recovery import spread_by
from .steps import block_of, blocks_of, range_of, work_at, work_of


class Room(NamedTuple):
    """What a block moves and weighs a chunk of members in.

    Their next states (CHUNK, nx), normal numbers (CHUNK nx,), what they expect of the sensor (CHUNK, ny); for a
    particle's own noise a root L (nx, nx) and room for it; R = F diag(d) Fᵀ of the rows that are there (ny, ny).
    """

    forward: Any
    z: Any
    expected: Any
    L: Any
    spare: Any
    F: Any
    d: Any
    end: int


@layout
def room_at(at, nx, ny):
    """Lay it out."""
    forward, at = take_matrix(at, CHUNK, nx)
    z, at = take_vector(at, CHUNK * nx)
    expected, at = take_matrix(at, CHUNK, ny)
    L, at = take_matrix(at, nx, nx)
    spare, at = take_matrix(at, nx, nx)
    F, at = take_matrix(at, ny, ny)
    d, at = take_vector(at, ny)
    return Room(forward, z, expected, L, spare, F, d, at)


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch of the bootstrap and regularised filters: the cloud's, and a room for each block."""
    n = members(options)
    return size_of(work_at, nx, ny, n) + blocks_of(n) * size_of(room_at, nx, ny)


@jit
def room_of(context, shared, b):
    """The room of block b."""
    nx, ny = context.nx, context.width
    return room_at(shared.end + b * room_at(0, nx, ny).end, nx, ny)


@jit
def _settle_finite(forward, records, log_w):
    """Move the members whose next state is finite; the others weigh nothing. Returns how many were lost."""
    nx = forward.shape[1]
    lost = 0
    for i in range(log_w.size):
        finite = True
        for j in range(nx):
            finite &= np.isfinite(forward[i, j])
        if finite:
            for j in range(nx):
                records[i, j] = forward[i, j]
        else:
            log_w[i] = -np.inf
            lost += 1
    return lost


@jit
def propagate_block(context, u, dt, sensor, y, key, value, state, work, number):
    """x ← f(x) + L z for a block's members; one that becomes infinite or NaN stays put and gets weight zero.

    The block's first sum is how many were lost.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    shared, cloud = work_of(context, work), cloud_of(state, nx, n)
    room = room_of(context, shared, number)
    records, log_w = cloud.records, cloud.log_w
    forward, z = room.forward, room.z
    varies = context.Q_varies != 0
    L = room.L if varies else shared.L
    circular = circular_states(context)
    diagonal = context.Q == 0
    noises = context.n_noises if diagonal else nx
    noisy = ints(context.noise_state, context.n_noises)
    angles = np.any(circular)
    jumps = context.jump != 0
    chances = np.empty(context.n_modes)
    first, last = range_of(number, n)
    lost = 0
    for begin in range(first, last, CHUNK):
        count = min(CHUNK, last - begin)
        if jumps:
            for i in range(begin, begin + count):
                jump(context, records[i], u, dt, jump_key(key), i, chances)
        transition_points(context, records[begin : begin + count], u, dt, forward)
        fill_normals(key, np.uint64(begin) * np.uint64(noises), count * noises, z)
        if diagonal:
            for k in range(noises):
                j = noisy[k]
                scale = L[j, j]
                for i in range(count):
                    forward[i, j] += scale * z[i * noises + k]
        else:
            for i in range(count):
                if varies:
                    noise_root(context, records[begin + i], u, dt, L, room.spare)
                add_noise(L, z[i * noises :], forward[i])
        if all_finite(count * nx, forward):
            for i in range(count):
                for j in range(nx):
                    records[begin + i, j] = forward[i, j]
        else:
            lost += _settle_finite(forward, records[begin : begin + count], log_w[begin : begin + count])
        if angles:
            for i in range(count):
                wrap_record(circular, records[begin + i])
    block_of(context, shared, number).sums[0] = lost


@jit
def smooth_block(context, u, dt, sensor, y, key, value, state, work, number):
    """x ← x + L z: a draw from the kernel of the regularised filter."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    first, last = range_of(number, n)
    shared, records = work_of(context, work), cloud_of(state, nx, n).records
    if numbers(context)[DUPLICATES] == 0.0:
        spread_by(context, shared.L, key, first, records[first:last])
        return
    # Siblings stand side by side: runs of members that have one move.
    ancestors = shared.ancestors
    begin = first
    for i in range(first, last + 1):
        alone = i == last or not (
            (i > 0 and ancestors[i - 1] == ancestors[i]) or (i + 1 < n and ancestors[i + 1] == ancestors[i])
        )
        if alone:
            if i > begin:
                spread_by(context, shared.L, key, begin, records[begin:i])
            begin = i + 1
