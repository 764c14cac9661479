"""What the Rao-Blackwellised filter does to its particles: draw, predict and condition, in blocks.

A record is x (nx,) and P (nx, nx): the sampled states and the mode as values, the mean of the linear states in their
places of x, their covariance in their rows of P; the other rows are zero. So F P Fᵀ + Q is the covariance of the whole
next state given what the particle has sampled so far, and P adds to the cloud's covariance as it is.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..compiled.context import (
    add_process_noise,
    circular_rows,
    circular_states,
    expect,
    linear_states,
    sampled_states,
    sensor_variances,
    transition,
)
from ..compiled.context import options as numbers
from ..compiled.jacobians import scratch_size, sensor_jacobian, state_jacobian
from ..compiled.verdict import LOG_2PI
from ..estimator import Options
from ..gaussian.shared import factor
from ..model.state_space import StateSpaceModel
from ..numerics.jit import address, floats, jit, matrix
from ..numerics.linalg import solve_transposed, wrap
from ..numerics.random import ONE, normal
from ..numerics.threads import threaded
from ..tuning import Tuning
from .mode_draws import jump, jump_key
from .shared import BLOCK, EQUAL, EXTRA, MEMBERS, THREADS, blocks_of, log_weights, members, records_of, wrap_record
from .steps import OWN, block_count, block_signature, block_size, blocks_start, shared, sums_size
from .steps import tune as tune_cloud
from .steps import work_size as cloud_work_size

PREDICT, CONDITION, ADOPT = range(OWN, OWN + 3)
"""Phases: one step on; each particle's own posterior and density of the reading, aside; that posterior made its own."""

THREADED_FROM = 4 * BLOCK
"""Particles from which threads gain more than they cost: fewer than of `pf`, since each takes ten times as long."""

_ROUNDING = 1e-13
"""A variance below this part of what it was made from is rounding."""


def own_numbers(nx: int, ny: int) -> int:
    """Scratch of a block: F, T, C, Q; H, B; S, U; e, ŷ; x', column, before; a Jacobian's."""
    return 4 * nx * nx + 2 * nx * ny + 2 * ny * ny + 2 * ny + 3 * nx + scratch_size(nx, ny)


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: the cloud's, the particles' own posteriors (N, nx + nx²), and each block's own."""
    n = members(options)
    return cloud_work_size(options, nx, ny) + n * (nx + nx * nx) + blocks_of(n) * own_numbers(nx, ny)


@lru_cache(maxsize=1)
def _own_code() -> float:
    return float(address(_block, block_signature))


def tune(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The cloud's numbers, and where the code of the phases above starts."""
    values = tune_cloud(options, model, tuning)
    values[EXTRA] = _own_code()
    values[THREADS] = members(options) >= THREADED_FROM and threaded()
    return values


@jit
def _given(C, j, step, x, column):
    """Condition N(x, C) on state j, which turns out `step` standard deviations above its mean: x_j moves there too."""
    nx = x.size
    scale = 1.0 / np.sqrt(C[j, j])
    for i in range(nx):
        column[i] = C[i, j] * scale
        x[i] += column[i] * step
    for i in range(nx):
        a = column[i]
        for k in range(nx):
            C[i, k] -= a * column[k]


@jit
def _drop(C, j):
    """Nothing is uncertain about state j any more."""
    for i in range(C.shape[0]):
        C[i, j] = 0.0
        C[j, i] = 0.0


@jit
def fix_mode(context, C, mode, x, column):
    """Condition N(x, C), whose mode is a number with mean and variance, on the mode that was drawn."""
    j = context.mode
    if C[j, j] > 0.0:
        _given(C, j, (mode - x[j]) / np.sqrt(C[j, j]), x, column)
    _drop(C, j)
    x[j] = mode


@jit
def sample(context, C, key, place, x, column, before):
    """Draw the sampled states of N(x, C), one after another; each draw conditions what is left.

    x becomes the drawn values and the mean of the linear states given them, C their covariance. For the prediction
    N(f, F P Fᵀ + Q) of a particle this is the time update of Schön, Gustafsson & Nordlund (2005), theorem 1: what the
    sampled states did says something of the linear states that drove them (their "third step"), noise that both share
    included. A state without variance moves without a draw.
    """
    drawn = sampled_states(context)
    for k in range(drawn.size):
        before[k] = C[drawn[k], drawn[k]]
    for k in range(drawn.size):
        j = drawn[k]
        if C[j, j] > _ROUNDING * before[k]:
            _given(C, j, normal(key, place), x, column)
        place += ONE
        _drop(C, j)


@jit
def _lose(log_w, P, i):
    """A particle that left the numbers weighs nothing."""
    log_w[i] = -np.inf
    for j in range(P.shape[0]):
        for k in range(P.shape[0]):
            P[j, k] = 0.0


@jit
def _predict(context, u, dt, key, state, first, last, F, T, C, Q, forward, column, before, scratch):
    """One step of the members `first` to `last`: m ~ chances, x ← f(x), P ← F P Fᵀ + Q, and the sampled states drawn.

    Returns:
        How many were lost.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    log_w = log_weights(state, nx, n)
    records = records_of(state, nx, n)
    circular = circular_states(context)
    linear = linear_states(context)
    jumps = context.jump != 0
    jumping = jump_key(key)
    chances = np.empty(context.n_modes)
    varies = context.Q_varies != 0
    width = np.uint64(sampled_states(context).size)
    lost = 0
    for i in range(first, last):
        x = records[i, :nx]
        P = matrix(records[i], nx, nx, nx)
        if jumps:
            jump(context, x, u, dt, jumping, i, chances)
        if varies or i == first:
            for a in range(nx):
                for b in range(nx):
                    Q[a, b] = 0.0
            add_process_noise(context, x, u, dt, Q, T)
        transition(context, x, u, dt, forward)
        for a in range(nx):
            for b in range(nx):
                C[a, b] = Q[a, b]
        if linear.size > 0:
            state_jacobian(context, x, u, dt, F, scratch)
            for a in range(nx):
                for b in linear:
                    s = 0.0
                    for c in linear:
                        s += F[a, c] * P[c, b]
                    T[a, b] = s
                for b in range(a + 1):
                    s = 0.0
                    for c in linear:
                        s += T[a, c] * F[b, c]
                    C[a, b] += s
                    if b < a:
                        C[b, a] += s
        if jumps:
            _drop(C, context.mode)
            forward[context.mode] = x[context.mode]
        sample(context, C, key, np.uint64(i) * width, forward, column, before)
        finite = True
        for j in range(nx):
            finite &= np.isfinite(forward[j]) and np.isfinite(C[j, j])
        if not finite:
            _lose(log_w, P, i)
            lost += 1
            continue
        for a in range(nx):
            x[a] = forward[a]
            for b in range(nx):
                P[a, b] = C[a, b]
        wrap_record(circular, x)
    return lost


@jit
def posteriors(context, work, n):
    """What `CONDITION` leaves aside for each particle, (N, nx + nx²)."""
    nx = context.nx
    return matrix(work, blocks_start(context, n) + block_count(n) * block_size(context), n, nx + nx * nx)


@jit
def _condition(
    context, sensor, u, y, reference, state, joint, after, first, last, H, B, S, U, e, expected, scratch, sums
):
    """Condition the members `first` to `last` on the reading, into `after`: a Kalman update of each one's linear part.

    x ← x + K e;  P ← P - K S Kᵀ;  joint = log w + log N(e; 0, S),  S = H P Hᵀ + R, over the finite rows. `sums` gets
    the moments of the predicted reading, about `reference`, under the weights before it.
    """
    nx = context.nx
    n = joint.size
    log_w = log_weights(state, nx, n)
    records = records_of(state, nx, n)
    linear = linear_states(context)
    r = sensor_variances(context, sensor)
    angles = circular_rows(context, sensor)
    circular = circular_states(context)
    equal = state[EQUAL] != 0.0
    for k in range(sums.size):
        sums[k] = 0.0
    sums[2] = -np.inf
    for i in range(first, last):
        joint[i] = -np.inf
        if not log_w[i] > -np.inf:
            continue
        x = records[i, :nx]
        P = matrix(records[i], nx, nx, nx)
        expect(context, sensor, x, u, expected)
        if linear.size > 0:
            sensor_jacobian(context, sensor, x, u, H, scratch)
        m = 0
        for row in range(r.size):
            if not np.isfinite(y[row]):
                continue
            e[m] = y[row] - expected[row]
            # Row `row` moves up to m ≤ row: the deviation of ŷ from the reference.
            expected[m] = expected[row] - reference[row]
            if angles[row] != 0:
                e[m] = wrap(e[m])
                expected[m] = wrap(expected[m])
            for j in linear:
                s = 0.0
                for k in linear:
                    s += P[j, k] * H[row, k]
                B[j, m] = s
            for k in linear:
                H[m, k] = H[row, k]
            for k in range(m + 1):
                s = 0.0
                for j in linear:
                    s += H[k, j] * B[j, m]
                S[k, m] = s
                S[m, k] = s
            S[m, m] += r[row]
            m += 1
        if not factor(S, U, m, nx):
            continue
        w = 1.0 if equal else np.exp(log_w[i])
        sums[0] += w
        for a in range(m):
            sums[4 + a] += w * expected[a]
            for b in range(a + 1):
                sums[4 + m + a * m + b] += w * (expected[a] * expected[b] + S[a, b])
        solve_transposed(U, m, e)
        value = log_w[i] - 0.5 * m * LOG_2PI
        for k in range(m):
            value -= 0.5 * e[k] * e[k] + np.log(U[k, k])
        if not -np.inf < value < np.inf:
            continue
        joint[i] = value
        if value > sums[2]:
            sums[2] = value
            sums[3] = i
        # B becomes W = B U⁻¹: K e = W U⁻ᵀ e and K S Kᵀ = W Wᵀ.
        own = after[i]
        for j in range(own.size):
            own[j] = records[i, j]
        for j in linear:
            solve_transposed(U, m, B[j])
            for k in range(m):
                own[j] += B[j, k] * e[k]
        for j in linear:
            for a in linear:
                if a > j:
                    break
                s = 0.0
                for k in range(m):
                    s += B[j, k] * B[a, k]
                own[nx + j * nx + a] -= s
                own[nx + a * nx + j] = own[nx + j * nx + a]
        wrap_record(circular, own)


@jit
def _adopt(context, state, joint, after, first, last):
    """Make the posteriors of the members that have one their own."""
    nx = context.nx
    records = records_of(state, nx, joint.size)
    for i in range(first, last):
        if joint[i] > -np.inf:
            for j in range(nx + nx * nx):
                records[i, j] = after[i, j]


@jit
def _block(phase, context, u, dt, sensor, y, key, value, state, work, b):
    nx, ny = context.nx, context.width
    n = int(numbers(context)[MEMBERS])
    first, last = b * BLOCK, min(n, (b + 1) * BLOCK)
    joint = floats(work.ctypes.data + 8 * n, n)
    after = posteriors(context, work, n)
    sums = floats(work.ctypes.data + 8 * (blocks_start(context, n) + b * block_size(context)), sums_size(context))
    if phase == ADOPT:
        _adopt(context, state, joint, after, first, last)
        return
    own = 4 * nx * nx + 2 * nx * ny + 2 * ny * ny + 2 * ny + 3 * nx + 2 * nx + 2 * max(nx, ny)
    at = blocks_start(context, n) + block_count(n) * block_size(context) + n * (nx + nx * nx) + b * own
    F = matrix(work, at, nx, nx)
    T = matrix(work, at + nx * nx, nx, nx)
    C = matrix(work, at + 2 * nx * nx, nx, nx)
    Q = matrix(work, at + 3 * nx * nx, nx, nx)
    at += 4 * nx * nx
    forward = floats(work.ctypes.data + 8 * at, nx)
    column = floats(work.ctypes.data + 8 * (at + nx), nx)
    before = floats(work.ctypes.data + 8 * (at + 2 * nx), nx)
    at += 3 * nx
    scratch = floats(work.ctypes.data + 8 * at, 2 * nx + 2 * max(nx, ny))
    at += 2 * nx + 2 * max(nx, ny)
    if phase == PREDICT:
        lost = _predict(context, u, dt, key, state, first, last, F, T, C, Q, forward, column, before, scratch)
        sums[0] = lost
        return
    m = sensor_variances(context, sensor).size
    H = matrix(work, at, m, nx)
    B = matrix(work, at + ny * nx, nx, m)
    S = matrix(work, at + 2 * ny * nx, m, m)
    U = matrix(work, at + 2 * ny * nx + ny * ny, m, m)
    at += 2 * ny * nx + 2 * ny * ny
    e = floats(work.ctypes.data + 8 * at, m)
    expected = floats(work.ctypes.data + 8 * (at + ny), m)
    _, _, _, _, _, reference, _ = shared(context, work, n)
    _condition(
        context, sensor, u, y, reference, state, joint, after, first, last, H, B, S, U, e, expected, scratch, sums
    )
