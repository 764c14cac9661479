"""The steps of a particle filter over its members, in blocks, on one thread or several.

A step is a phase that `sweep` runs over all blocks; what it leaves per block is added up in order afterwards. The
scratch of a filter holds, in this order: weights (N,), joint log weights (N,), log likelihoods of a first stage (N,),
a shared part, and a part for each block (see `Shared` and `scratch_numbers`).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import prange, types

from ..compiled.context import (
    circular_rows,
    circular_states,
    context_at,
    context_type,
    expect,
    expect_rows,
    has_own_likelihood,
    own_likelihood,
    place_of,
    sensor_variances,
    transition_rows,
)
from ..compiled.context import options as numbers
from ..compiled.noise import add_noise, noise_root
from ..compiled.verdict import LOG_2PI
from ..estimator import Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import F1, address, caller, f64, floats, i64, ints, jit, matrix
from ..numerics.linalg import wrap
from ..numerics.random import fill_normals
from ..numerics.simd import total as total_of
from ..numerics.simd_exp import exp_minus
from ..numerics.threads import threaded
from ..tuning import Tuning
from .mode_draws import jump, jump_key
from .resampling import STRATIFIED, copy_children, drawn_children, match_children, strata_children
from .shared import (
    BLOCK,
    BLOCK_CODE,
    CHUNK,
    EQUAL,
    ESS,
    EXTRA,
    FRACTION,
    HEAD,
    MEMBERS,
    RESAMPLED,
    SCHEME,
    SETTLED,
    THREADED_FROM,
    THREADS,
    add_chunk,
    add_members,
    add_up,
    blocks_of,
    finish_moments,
    log_weights,
    members,
    records_of,
    settled_moments,
    spread_by,
    weigh_equally,
    wrap_record,
)

PROPAGATE, WEIGH, NORMALISE, CHILDREN, COMMIT, JITTER = range(6)
"""Phases: x ~ p(x | x'); p(y | x); weights and moments; children of strata; keep the weights; kernel noise."""

OWN = 16
"""Phases from here on are a filter's own; its code stands in the option `EXTRA`."""


def shared_numbers(nx: int, ny: int) -> int:
    """Numbers that all blocks read: sums, L, its scratch, S, its factor, ν, reference, mean log density."""
    k = max(nx, ny)
    return 4 + k + k * k + 2 * nx * nx + 2 * ny * ny + ny + nx + 1


def block_numbers(nx: int, ny: int) -> int:
    """Numbers of one block: its sums; z, ŷ and deviations of a chunk; L and its scratch; where points begin."""
    k = max(nx, ny)
    return 4 + k + k * k + (nx + ny) * CHUNK + 2 * nx * nx + (k + 2) * CHUNK + 1


def tune(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The numbers that the compiled functions read, in the order of `MEMBERS` and the following."""
    n = members(options)
    threads = n >= THREADED_FROM and threaded()
    fraction, scheme = options.get("fraction", 1.0), round(options["resampling"])
    return np.array([n, fraction, scheme, threads, block_code(), 0.0], float)


def work_size(options: dict[str, float], nx: int, ny: int) -> int:
    """Scratch of the bootstrap and regularised filters."""
    n = members(options)
    return 2 * n + shared_numbers(nx, ny) + blocks_of(n) * block_numbers(nx, ny)


@jit
def sums_size(context):
    """Length of a block's sums."""
    k = max(context.nx, context.width)
    return 4 + k + k * k


@jit
def shared(context, work, n):
    """Views of the shared part: sums, L, scratch (nx, nx), S, its factor, ν, reference."""
    nx, ny = context.nx, context.width
    at = 2 * n
    k = sums_size(context)
    sums = floats(work.ctypes.data + 8 * at, k)
    at += k
    L = matrix(work, at, nx, nx)
    at += nx * nx
    spare = matrix(work, at, nx, nx)
    at += nx * nx
    S = floats(work.ctypes.data + 8 * at, ny * ny)
    at += ny * ny
    U = floats(work.ctypes.data + 8 * at, ny * ny)
    at += ny * ny
    nu = floats(work.ctypes.data + 8 * at, ny)
    at += ny
    reference = floats(work.ctypes.data + 8 * at, nx)
    return sums, L, spare, S, U, nu, reference


@jit
def block_size(context):
    """Numbers of one block, as in `block_numbers`."""
    nx, ny = context.nx, context.width
    return sums_size(context) + (nx + ny) * CHUNK + 2 * nx * nx + (max(nx, ny) + 2) * CHUNK + 1


@jit
def blocks_start(context, n):
    """Where the blocks' parts begin."""
    nx, ny = context.nx, context.width
    return 2 * n + sums_size(context) + 2 * nx * nx + 2 * ny * ny + ny + nx + 1


@jit
def block_count(n):
    """Blocks that n members make."""
    return (n + BLOCK - 1) // BLOCK


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
def propagate(context, u, dt, key, state, first, last, L, scratch, D, z):
    """x ← f(x) + L z for the members `first` to `last`; one that leaves the numbers stays put and weighs nothing.

    D and z have room for `CHUNK` states.

    Returns:
        How many were lost.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    records = records_of(state, nx, n)
    log_w = log_weights(state, nx, n)
    circular = circular_states(context)
    diagonal = context.Q == 0
    varies = context.Q_varies != 0
    noises = context.n_noises if diagonal else nx
    noisy = ints(context.noise_state, context.n_noises)
    forward = matrix(D, 0, CHUNK, nx)
    angles = np.any(circular)
    jumps = context.jump != 0
    chances = np.empty(context.n_modes)
    lost = 0
    for begin in range(first, last, CHUNK):
        count = min(CHUNK, last - begin)
        if jumps:
            for i in range(begin, begin + count):
                jump(context, records[i], u, dt, jump_key(key), i, chances)
        transition_rows(context, records[begin].ctypes.data, records.shape[1], count, u, dt, forward)
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
                    noise_root(context, records[begin + i], u, dt, L, scratch)
                add_noise(L, z[i * noises :], forward[i])
        # One sum says that all are finite, as they are but for accidents.
        if np.isfinite(total_of(count * nx, forward.ctypes.data)):
            for i in range(count):
                for j in range(nx):
                    records[begin + i, j] = forward[i, j]
        else:
            lost += _settle_finite(forward, records[begin : begin + count], log_w[begin : begin + count])
        if angles:
            for i in range(count):
                wrap_record(circular, records[begin + i])
    return lost


@jit
def first_residual(context, u, sensor, y, x, out):
    """What a reading leaves over the expectation of a particle x, by row, and 0 where it is no number.

    The residuals' moments are taken about that of the first particle: the spread of the particles then keeps its digits
    however far off the reading is.
    """
    expect(context, sensor, x, u, out)
    circular = circular_rows(context, sensor)
    for row in range(out.size):
        out[row] = y[row] - out[row]
        if circular[row] != 0:
            out[row] = wrap(out[row])
        if not np.isfinite(out[row]):
            out[row] = 0.0


@jit
def about(residual, reference, circular):
    """A residual's deviation from a reference; of angles the shorter way."""
    deviation = residual - reference
    return wrap(deviation) if circular != 0 else deviation


@jit
def weigh(context, u, sensor, y, state, joint, first, last, expected, D, sums):
    """joint = log w + log p(y | x), and the sums of the residuals' mean and covariance under the predicted weights.

    p(y | x) is Gaussian over the finite rows of y, or the sensor's own; a density that is no number counts as zero. The
    sums are about `first_residual`.
    """
    nx = context.nx
    records = records_of(state, nx, joint.size)
    log_w = log_weights(state, nx, joint.size)
    equal = state[EQUAL] != 0.0
    r = sensor_variances(context, sensor)
    circular = circular_rows(context, sensor)
    own = has_own_likelihood(context, sensor)
    for k in range(sums.size):
        sums[k] = 0.0
    sums[2] = -np.inf
    ny = r.size
    reference = np.empty(ny)
    first_residual(context, u, sensor, y, records[0], reference)
    m = 0
    constant = 0.0
    for row in range(ny):
        if np.isfinite(y[row]):
            m += 1
            constant -= 0.5 * (LOG_2PI + np.log(r[row]))
    top = -np.inf
    for begin in range(first, last, CHUNK):
        n = min(CHUNK, last - begin)
        expect_rows(context, sensor, records[begin].ctypes.data, records.shape[1], n, u, expected)
        for row in range(ny):
            for i in range(n):
                D[row, i] = y[row] - expected[i, row]
        for i in range(n):
            joint[begin + i] = constant
        k = 0
        for row in range(ny):
            if not np.isfinite(y[row]):
                continue
            # Row `row` moves up to k ≤ row.
            d = D[k]
            weight = 0.5 / r[row]
            for i in range(n):
                e = D[row, i]
                if circular[row] != 0:
                    e = wrap(e)
                d[i] = about(e, reference[row], circular[row])
                joint[begin + i] -= weight * e * e
            k += 1
        if own:
            for i in range(n):
                joint[begin + i] = own_likelihood(context, sensor, y, records[begin + i, :nx], u)
        # Row m + 1 is free for the weights until the sums are made.
        if equal:
            for i in range(n):
                D[m + 1, i] = 1.0
        else:
            exp_minus(n, log_w[begin:].ctypes.data, 0.0, D[m + 1].ctypes.data)
        for i in range(n):
            w = D[m + 1, i]
            value = joint[begin + i] + log_w[begin + i]
            # A density that is no number, or an expectation: the particle is out, and out of the sums.
            if not -np.inf < value < np.inf:
                value = -np.inf
                for k in range(m):
                    if not np.isfinite(D[k, i]):
                        w = 0.0
                        D[k, i] = 0.0
            joint[begin + i] = value
            D[m, i] = w
            if value > top:
                top = value
                sums[3] = begin + i
        add_chunk(D, n, m, sums)
    sums[2] = top


@jit
def weigh_block(context, state, joint, w, first, last, top, reference, D, sums):
    """w = exp(joint - top) of the members `first` to `last`, and their sums."""
    for k in range(sums.size):
        sums[k] = 0.0
    exp_minus(last - first, joint[first:].ctypes.data, top, w[first:].ctypes.data)
    nx = context.nx
    records = records_of(state, nx, joint.size)
    add_members(state[HEAD : HEAD + nx], w[first:last], records[first:last], reference, D, sums)


@jit
def _block(phase, context, u, dt, sensor, y, key, value, state, work, b):
    nx, ny = context.nx, context.width
    n = int(numbers(context)[MEMBERS])
    first, last = b * BLOCK, min(n, (b + 1) * BLOCK)
    w = floats(work.ctypes.data, n)
    joint = floats(work.ctypes.data + 8 * n, n)
    _, L, _, _, _, _, reference = shared(context, work, n)
    at = blocks_start(context, n) + b * block_size(context)
    size = sums_size(context)
    sums = floats(work.ctypes.data + 8 * at, size)
    at += size
    z = floats(work.ctypes.data + 8 * at, nx * CHUNK)
    at += nx * CHUNK
    expected = work.ctypes.data + 8 * at
    at += CHUNK * ny
    D = matrix(work, at, max(nx, ny) + 2, CHUNK)
    at += (max(nx, ny) + 2) * CHUNK
    if phase == PROPAGATE:
        own = matrix(work, at, nx, nx) if context.Q_varies != 0 else L
        lost = propagate(context, u, dt, key, state, first, last, own, matrix(work, at + nx * nx, nx, nx), D, z)
        sums[0] = lost
    elif phase == WEIGH:
        weigh(
            context,
            u,
            sensor,
            y,
            state,
            joint,
            first,
            last,
            matrix(floats(expected, CHUNK * ny), 0, CHUNK, sensor_variances(context, sensor).size),
            D,
            sums,
        )
    elif phase == NORMALISE:
        weigh_block(context, state, joint, w, first, last, value, reference, D, sums)
    elif phase == CHILDREN:
        # The points at which this block begins, and the next one, stand in the last number of their parts.
        at = blocks_start(context, n) + (b + 1) * block_size(context) - 1
        after = n if last == n else work[at + block_size(context)]
        strata_children(
            int(numbers(context)[SCHEME]), key, w[first:last], work[at], float(after), value, joint[first:last]
        )
    elif phase == COMMIT:
        log_w = log_weights(state, nx, n)
        for i in range(first, last):
            log_w[i] = joint[i] - value
    elif phase == JITTER:
        spread_by(context, L, key, first, records_of(state, nx, n)[first:last])


block_signature = types.void(i64, context_type, F1, f64, i64, F1, types.uint64, f64, F1, F1, i64)
call_block = caller(block_signature)


@lru_cache(maxsize=1)
def block_code() -> float:
    """Where the machine code of the phases starts, among the options (an address has 48 bits, a float64 53).

    Called through a pointer it is compiled once, not again into each function that sweeps.
    """
    return float(address(_block, block_signature))


@jit(parallel=True)
def _on_threads(phase, context, u, dt, sensor, y, key, value, state, work, blocks):
    code = int(numbers(context)[BLOCK_CODE if phase < OWN else EXTRA])
    place = place_of(context)
    for b in prange(blocks):
        call_block(code, phase, context_at(place), u, dt, sensor, y, key, value, state, work, b)


@jit
def sweep(phase, context, u, dt, sensor, y, key, value, state, work):
    """Run a phase over all blocks."""
    blocks = block_count(int(numbers(context)[MEMBERS]))
    if numbers(context)[THREADS] != 0.0:
        _on_threads(phase, context, u, dt, sensor, y, key, value, state, work, blocks)
    else:
        code = int(numbers(context)[BLOCK_CODE if phase < OWN else EXTRA])
        for b in range(blocks):
            call_block(code, phase, context, u, dt, sensor, y, key, value, state, work, b)


@jit
def total(context, work, sums):
    """Add up what the last phase left in the blocks."""
    n = int(numbers(context)[MEMBERS])
    at = blocks_start(context, n)
    add_up(work[at:], block_count(n), block_size(context), sums)


@jit
def normalise(context, u, sensor, y, state, work, sums):
    """Weights, moments and effective sample size from the joint log weights, whose maximum stands in `sums`.

    Returns:
        log Σ exp(joint), the reading's log-likelihood; -inf if no particle explains it.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    top = sums[2]
    if not top > -np.inf:
        return -np.inf
    _, _, _, _, _, _, reference = shared(context, work, n)
    heaviest = records_of(state, nx, n)[int(sums[3])]
    for j in range(nx):
        reference[j] = heaviest[j]
    sweep(NORMALISE, context, u, 0.0, sensor, y, np.uint64(0), top, state, work)
    total(context, work, sums)
    return top + np.log(sums[0])


@jit
def keep(context, u, sensor, y, log_sum, sums, state, work):
    """Make the weights of `normalise` the state's, with its mean and covariance."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    _, _, _, _, _, _, reference = shared(context, work, n)
    mean, cov = settled_moments(state, nx)
    finish_moments(state, sums, reference, mean, cov)
    sweep(COMMIT, context, u, 0.0, sensor, y, np.uint64(0), log_sum, state, work)
    state[SETTLED] = 1.0
    state[EQUAL] = 0.0
    state[ESS] = sums[0] * sums[0] / sums[1]


@jit
def children_of(context, u, sensor, y, key, sums, state, work):
    """Number of children of each particle for the weights of `normalise`, (N,), in the place of the joint weights."""
    n = int(numbers(context)[MEMBERS])
    w = floats(work.ctypes.data, n)
    joint = floats(work.ctypes.data + 8 * n, n)
    scheme = int(numbers(context)[SCHEME])
    if scheme > STRATIFIED:
        drawn_children(scheme, key, w, sums[0], joint)
        return joint
    scale = n / sums[0]
    stride = block_size(context)
    at = blocks_start(context, n)
    begun = 0.0
    for b in range(block_count(n)):
        work[at + (b + 1) * stride - 1] = min(begun * scale, float(n))
        begun += work[at + b * stride]
    sweep(CHILDREN, context, u, 0.0, sensor, y, key, scale, state, work)
    return joint


@jit
def resample(context, u, sensor, y, key, sums, state, work):
    """Let each particle of the weights of `normalise` have its children, of equal weight."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    children = children_of(context, u, sensor, y, key, sums, state, work)
    parents = floats(work.ctypes.data, n)
    copy_children(match_children(children, parents), children, parents, records_of(state, nx, n))
    effective = state[ESS]
    weigh_equally(state, nx, n)
    state[ESS] = effective
    state[RESAMPLED] += 1.0


@jit
def impoverished(context, state):
    """Whether the effective sample size, 1 / Σ w², has fallen under its part of N.

    Source: Kong, Liu & Wong (1994), Sequential imputations, doi:10.1080/01621459.1994.10476469.
    """
    return state[ESS] < numbers(context)[FRACTION] * numbers(context)[MEMBERS]
