"""One particle of the Rao-Blackwellised filter: a Kalman filter of the linear states, given the drawn ones.

A record is x (nx,) and P (nx, nx): the sampled states and the mode as values, the mean of the linear states in their
places of x, their covariance in their rows of P; the other rows are zero. So F P Fᵀ + Q is the covariance of the whole
next state given the particle's samples so far, and P adds to the cloud's covariance as it is.

Source: Schön, Gustafsson & Nordlund (2005), doi:10.1109/TSP.2005.849151, theorem 1 and algorithm 1, step 4.
"""

from __future__ import annotations

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
from ..compiled.jacobians import scratch_size, sensor_jacobian, state_jacobian
from ..compiled.noise import add_covariances
from ..compiled.verdict import LOG_2PI
from ..estimator import Options
from ..gaussian.shared import factor
from ..model.state_space import StateSpaceModel
from ..numerics.jit import jit, threaded
from ..numerics.linalg import copy, solve_transposed, wrap
from ..numerics.random import ONE, normal
from ..numerics.workspace import declare_layout
from ..tuning import Tuning
from .cloud import (
    BLOCK,
    EQUAL,
    THREADS,
    clear_sums,
    count_of,
    members,
    own_cloud,
    own_covariance,
    wrap_record,
)
from .cloud import tune as tune_cloud
from .draws import jump, jump_key
from .innovation import add_gaussian, first_residual
from .weights import OWN, block_of, members_own, range_of, work_of, work_sized

PREDICT, CONDITION, ADOPT = range(OWN, OWN + 3)
"""Phases: one step on; each particle's posterior and density of the measurement, aside; adoption of that posterior."""


THREADED_FROM = 4 * BLOCK
"""Particles from which threads gain more than they cost: fewer than for `pf`, since each takes ten times as long."""


KalmanRoom, room_at = declare_layout(
    "KalmanRoom",
    "nx, ny",
    scratch_size,
    F="nx, nx",
    T="nx, nx",
    C="nx, nx",
    Q="nx, nx",
    forward="nx",
    column="nx",
    before="nx",
    H="ny, nx",
    B="nx, ny",
    S="ny, ny",
    U="ny, ny",
    e="ny",
    expected="ny",
    scratch="scratch_size(nx, ny)",
)
"""Scratch of a block for one particle: F, T, C and Q of a step; the next state, a column, and the variances before
draws; H, B = P Hᵀ, S and its factor U, e and ŷ of an update; scratch of a Jacobian."""


work_size = work_sized(room_at, lambda nx: nx + nx * nx)


@jit
def posteriors_of(context, shared):
    """Return the particles' posteriors (N, nx + nx²) before they are adopted."""
    posteriors, _ = members_own(context, shared, context.nx + context.nx * context.nx)
    return posteriors


@jit
def room_of(context, shared, b):
    """Return the room of block b."""
    nx, ny = context.nx, context.width
    _, rooms = members_own(context, shared, nx + nx * nx)
    return room_at(rooms + b * room_at(0, nx, ny).end, nx, ny)


def tune(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """Return the cloud's numbers, with threads from fewer particles on."""
    values = tune_cloud(options, model, tuning)
    values[THREADS] = members(options) >= THREADED_FROM and threaded()
    return values


_ROUNDING = 1e-13
"""Share of the variance before conditioning below which a variance is rounding."""


@jit
def _given(C, j, step, x, column):
    """Condition N(x, C) on state j lying `step` standard deviations above its mean; x_j moves there too."""
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
def drop(C, j):
    """Remove the uncertainty of state j."""
    C[:, j] = 0.0
    C[j] = 0.0


@jit
def fix_mode(context, C, mode, x, column):
    """Condition N(x, C), whose mode has a mean and a variance, on the mode that was drawn."""
    j = context.mode
    if C[j, j] > 0.0:
        _given(C, j, (mode - x[j]) / np.sqrt(C[j, j]), x, column)
    drop(C, j)
    x[j] = mode


@jit
def sample(context, C, key, place, x, column, before):
    """Draw the sampled states of N(x, C), one after another; each draw conditions the rest.

    x becomes the drawn values and the mean of the linear states given them, C their covariance. For the prediction N(f,
    F P Fᵀ + Q) of a particle this is the time update of Schön, Gustafsson & Nordlund (2005), theorem 1: the motion of
    the sampled states is a measurement of the linear states that drove them (their "third step"), shared noise
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
        drop(C, j)


@jit
def predict_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Move a block's members one step: m ~ chances, x ← f(x), P ← F P Fᵀ + Q, and draw the sampled states.

    The block's first sum is the number of members lost: those that became infinite or NaN, which get weight zero.
    """
    nx, n = context.nx, count_of(context)
    shared, cloud = work_of(context, work), own_cloud(context, state)
    room = room_of(context, shared, number)
    F, T, C, Q, forward, column, before = room.F, room.T, room.C, room.Q, room.forward, room.column, room.before
    records, log_w = cloud.records, cloud.log_w
    first, last = range_of(number, n)
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
        P = own_covariance(records[i], nx)
        if jumps:
            jump(context, x, u, dt, jumping, i, chances)
        if varies or i == first:
            Q[:] = 0.0
            add_process_noise(context, x, u, dt, Q, T)
        transition(context, x, u, dt, forward)
        copy(Q, C)
        if linear.size > 0:
            state_jacobian(context, x, u, dt, F, room.scratch)
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
            drop(C, context.mode)
            forward[context.mode] = x[context.mode]
        sample(context, C, key, np.uint64(i) * width, forward, column, before)
        finite = True
        for j in range(nx):
            finite &= np.isfinite(forward[j]) and np.isfinite(C[j, j])
        if not finite:
            log_w[i] = -np.inf
            P[:] = 0.0
            lost += 1
            continue
        for a in range(nx):
            x[a] = forward[a]
        copy(C, P)
        wrap_record(circular, x)
    block_of(context, shared, number).sums[0] = lost


@jit
def condition_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Condition a block's members on the measurement, aside: a Kalman update of each one's linear part.

    x ← x + K e;  P ← P - K S Kᵀ;  joint = log w + log N(e; 0, S),  S = H P Hᵀ + R, over the finite rows. The sums are
    those of `expect_block` in proposals.py.
    """
    nx, n = context.nx, count_of(context)
    shared, cloud = work_of(context, work), own_cloud(context, state)
    room, sums = room_of(context, shared, number), block_of(context, shared, number).sums
    B, S, U, e, expected = room.B, room.S, room.U, room.e, room.expected
    joint, after = shared.joint, posteriors_of(context, shared)
    records, log_w = cloud.records, cloud.log_w
    first, last = range_of(number, n)
    linear = linear_states(context)
    r = sensor_variances(context, sensor)
    H = room.H[: r.size]
    angles = circular_rows(context, sensor)
    circular = circular_states(context)
    equal = state[EQUAL] != 0.0
    reference = np.empty(r.size)
    first_residual(context, u, sensor, y, records[0, :nx], reference)
    clear_sums(sums)
    for i in range(first, last):
        joint[i] = -np.inf
        if not log_w[i] > -np.inf:
            continue
        x = records[i, :nx]
        P = own_covariance(records[i], nx)
        expect(context, sensor, x, u, expected)
        if linear.size > 0:
            sensor_jacobian(context, sensor, x, u, H, room.scratch)
        m = 0
        for row in range(r.size):
            if not np.isfinite(y[row]):
                continue
            # Row `row` moves up to m ≤ row.
            e[m] = y[row] - expected[row]
            if angles[row] != 0:
                e[m] = wrap(e[m])
            expected[m] = e[m]
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
        add_covariances(context, sensor, y, 1.0, S)
        if not factor(S, U, m, nx):
            continue
        solve_transposed(U, m, e)
        density = log_w[i] - 0.5 * m * LOG_2PI
        for k in range(m):
            density -= 0.5 * e[k] * e[k] + np.log(U[k, k])
        if density < np.inf:
            add_gaussian(context, sensor, y, 1.0 if equal else np.exp(log_w[i]), reference, expected, S, sums)
        if not -np.inf < density < np.inf:
            continue
        joint[i] = density
        if density > sums[2]:
            sums[2] = density
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
def adopt_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Copy the posteriors of the members that have one into their records."""
    nx, n = context.nx, count_of(context)
    shared, records = work_of(context, work), own_cloud(context, state).records
    posteriors = posteriors_of(context, shared)
    first, last = range_of(number, n)
    for i in range(first, last):
        if shared.joint[i] > -np.inf:
            for j in range(nx + nx * nx):
                records[i, j] = posteriors[i, j]
