"""The steps of a particle filter over its members, in blocks, on one thread or several.

A step is a phase that `sweep` runs over all blocks; what it leaves per block is added up in order afterwards. The
scratch of a filter holds, in this order: weights (N,), joint log weights (N,), log likelihoods of a first stage (N,),
a shared part, and a part for each block (see `Shared` and `scratch_numbers`).
"""

from __future__ import annotations

import numpy as np
from numba import prange

from .context import (
    circular_rows,
    circular_states,
    expect,
    has_own_likelihood,
    own_likelihood,
    sensor_variances,
    transition,
)
from .context import options as numbers
from .gaussian import LOG_2PI
from .jit import floats, ints, jit, matrix
from .linalg import wrap
from .noise import add_noise, noise_root
from .particle import (
    BLOCK,
    EQUAL,
    ESS,
    FRACTION,
    MEMBERS,
    RESAMPLED,
    SCHEME,
    SETTLED,
    THREADS,
    add_deviation,
    add_up,
    blocks_of,
    finish_moments,
    log_weights,
    members,
    records_of,
    settled_moments,
    spread_by,
    weigh_block,
    weigh_equally,
    wrap_record,
)
from .random import normal
from .resampling import STRATIFIED, drawn_children, place_children, strata_children

PROPAGATE, WEIGH, NORMALISE, CHILDREN, COMMIT, JITTER = range(6)
"""Phases: x ~ p(x | x'); p(y | x); weights and moments; children of strata; keep the weights; kernel noise."""


def shared_numbers(nx: int, ny: int) -> int:
    """Numbers that all blocks read: sums, L, its scratch, S, its factor, ν, reference, mean log density."""
    k = max(nx, ny)
    return 4 + k + k * k + 2 * nx * nx + 2 * ny * ny + ny + nx + 1


def block_numbers(nx: int, ny: int) -> int:
    """Numbers of one block: its sums; x', d, z, e, ŷ; L and its scratch; and where its points begin."""
    k = max(nx, ny)
    return 4 + k + k * k + 3 * nx + 2 * ny + 2 * nx * nx + 1


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
    return sums_size(context) + 3 * nx + 2 * ny + 2 * nx * nx + 1


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
def propagate(context, u, dt, key, state, first, last, L, scratch, forward, z):
    """x ← f(x) + L z for the members `first` to `last`; one that leaves the numbers stays put and weighs nothing.

    Returns:
        How many were lost.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    records = records_of(state, nx, n)
    log_w = log_weights(state, nx, n)
    circular = circular_states(context)
    noises = context.n_noises if context.Q == 0 else nx
    noisy = ints(context.noise_state, context.n_noises)
    lost = 0
    for i in range(first, last):
        x = records[i]
        if context.Q_varies != 0:
            noise_root(context, x, u, dt, L, scratch)
        transition(context, x, u, dt, forward)
        place = np.uint64(i * noises)
        if context.Q == 0:
            for k in range(noises):
                j = noisy[k]
                forward[j] += L[j, j] * normal(key, place + np.uint64(k))
        else:
            for k in range(noises):
                z[k] = normal(key, place + np.uint64(k))
            add_noise(L, z, forward)
        finite = True
        for j in range(nx):
            finite = finite and np.isfinite(forward[j])
        if finite:
            for j in range(nx):
                x[j] = forward[j]
            wrap_record(circular, x)
        else:
            log_w[i] = -np.inf
            lost += 1
    return lost


@jit
def log_density(context, sensor, y, x, u, expected):
    """log p(y | x) from ŷ = h(x): Gaussian over the finite rows of y, or the sensor's own; -inf if it is not a number.

    Leaves the residual of each finite row in the leading entries of `expected`.
    """
    r = sensor_variances(context, sensor)
    circular = circular_rows(context, sensor)
    value = 0.0
    m = 0
    for row in range(r.size):
        if np.isfinite(y[row]):
            e = y[row] - expected[row]
            if circular[row] != 0:
                e = wrap(e)
            expected[m] = e
            value -= e * e / r[row]
            m += 1
    value *= 0.5
    if has_own_likelihood(context, sensor):
        value = own_likelihood(context, sensor, y, x, u)
    return value if value < np.inf else -np.inf


@jit
def log_constant(context, sensor, y):
    """What the Gaussian density of the finite rows adds to its exponent: -½ Σ log 2πr; 0 if the sensor has its own."""
    if has_own_likelihood(context, sensor):
        return 0.0
    r = sensor_variances(context, sensor)
    value = 0.0
    for row in range(r.size):
        if np.isfinite(y[row]):
            value -= 0.5 * (LOG_2PI + np.log(r[row]))
    return value


@jit
def weigh(context, u, sensor, y, state, joint, first, last, expected, sums):
    """joint = log w + log p(y | x), and the sums of the residual's mean and covariance under the predicted weights."""
    nx = context.nx
    n = joint.size
    records = records_of(state, nx, n)
    log_w = log_weights(state, nx, n)
    equal = state[EQUAL] != 0.0
    constant = log_constant(context, sensor, y)
    for k in range(sums.size):
        sums[k] = 0.0
    sums[2] = -np.inf
    ny = sensor_variances(context, sensor).size
    m = 0
    for row in range(ny):
        if np.isfinite(y[row]):
            m += 1
    for i in range(first, last):
        x = records[i]
        expect(context, sensor, x[:nx], u, expected[:ny])
        joint[i] = log_w[i] + constant + log_density(context, sensor, y, x[:nx], u, expected)
        w = 1.0 if equal else np.exp(log_w[i])
        finite = w > 0.0
        for k in range(m):
            finite = finite and np.isfinite(expected[k])
        if finite:
            add_deviation(w, expected, m, sums)
        if not joint[i] > -np.inf:
            joint[i] = -np.inf
        elif joint[i] > sums[2]:
            sums[2] = joint[i]
            sums[3] = i


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
    forward = floats(work.ctypes.data + 8 * at, nx)
    d = floats(work.ctypes.data + 8 * (at + nx), nx)
    z = floats(work.ctypes.data + 8 * (at + 2 * nx), nx)
    at += 3 * nx
    expected = floats(work.ctypes.data + 8 * at, 2 * ny)
    at += 2 * ny
    if phase == PROPAGATE:
        own = matrix(work, at, nx, nx) if context.Q_varies != 0 else L
        lost = propagate(context, u, dt, key, state, first, last, own, matrix(work, at + nx * nx, nx, nx), forward, z)
        sums[0] = lost
    elif phase == WEIGH:
        weigh(context, u, sensor, y, state, joint, first, last, expected, sums)
    elif phase == NORMALISE:
        weigh_block(state, joint, w, first, last, value, reference, d, sums)
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


@jit(parallel=True)
def _on_threads(phase, context, u, dt, sensor, y, key, value, state, work, blocks):
    for b in prange(blocks):
        _block(phase, context, u, dt, sensor, y, key, value, state, work, b)


@jit
def sweep(phase, context, u, dt, sensor, y, key, value, state, work):
    """Run a phase over all blocks."""
    blocks = block_count(int(numbers(context)[MEMBERS]))
    if numbers(context)[THREADS] != 0.0:
        _on_threads(phase, context, u, dt, sensor, y, key, value, state, work, blocks)
    else:
        for b in range(blocks):
            _block(phase, context, u, dt, sensor, y, key, value, state, work, b)


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
    place_children(children_of(context, u, sensor, y, key, sums, state, work), records_of(state, nx, n))
    effective = state[ESS]
    weigh_equally(state, nx, n)
    state[ESS] = effective
    state[RESAMPLED] += 1.0


@jit
def impoverished(context, state):
    """Whether the effective sample size, 1 / Σ w², has fallen under its part of N. Source: Kong, Liu & Wong (1994)."""
    return state[ESS] < numbers(context)[FRACTION] * numbers(context)[MEMBERS]
