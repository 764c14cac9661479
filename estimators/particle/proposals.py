"""Particles that wait for the reading before they move: what `pf-ekf` and `apf` share.

Between readings a particle carries the Gaussian of where it may be, N(x, P): x ← f(x), and P ← F P Fᵀ + Q from P = 0
at the last reading. One step from a certain particle is the model's own transition, exactly; over several steps it is
the EKF's approximation of it. The reading then says where in that Gaussian the particle goes, and a weight corrects
for the choice: in coordinates z of P = L Lᵀ, x + L z, so that a singular P is no obstacle.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..compiled.context import (
    add_process_noise,
    circular_rows,
    circular_states,
    expect,
    has_own_likelihood,
    own_likelihood,
    sensor_variances,
    transition,
)
from ..compiled.context import options as numbers
from ..compiled.jacobians import scratch_size, sensor_jacobian, state_jacobian
from ..compiled.noise import add_covariances, add_noise, has_correlated_rows, semidefinite_root
from ..compiled.verdict import LOG_2PI
from ..estimator import Options
from ..gaussian.shared import admit
from ..numerics.jit import inlined, jit
from ..numerics.linalg import cholesky, congruence, solve_transposed, wrap
from ..numerics.normal_score import add_tail
from ..numerics.random import key_of
from ..numerics.workspace import layout, size_of, take_matrix, take_vector
from .cloud import EQUAL, MEMBERS, PROCESS, SETTLED, cloud_of, members, next_draw, own_covariance, wrap_record
from .innovation import about, first_residual, predicted, score_rows
from .mode_draws import jump, jump_key
from .moments import tails_of
from .recovery import recover
from .steps import NO_KEY, add_up, block_of, blocks_of, range_of, sweep, work_at, work_of
from .weigh import log_density
from .weights import OWN

MOVE, EXPECT, PROPOSE = range(OWN, OWN + 3)
"""Phases: N(x, P) one step on; what it says of the reading; the filter's own draw."""


class Room(NamedTuple):
    """What a block's particles are worked on in, one after the other.

    F (nx, nx) and T (2 nx, nx) for F P Fᵀ; roots L and C (nx, nx); H and H L (ny, nx), S and its factor U (ny, ny), e
    and `seen` (ny,) of a look at the reading; the next state, z and ξ (nx,); R = G diag(d) Gᵀ of the rows that are
    there; what a Jacobian takes.
    """

    F: Any
    T: Any
    L: Any
    C: Any
    H: Any
    HL: Any
    S: Any
    U: Any
    e: Any
    seen: Any
    forward: Any
    z: Any
    xi: Any
    G: Any
    d: Any
    scratch: Any
    end: int


@layout
def room_at(at, nx, ny):
    """Lay it out."""
    F, at = take_matrix(at, nx, nx)
    T, at = take_matrix(at, 2 * nx, nx)
    L, at = take_matrix(at, nx, nx)
    C, at = take_matrix(at, nx, nx)
    H, at = take_matrix(at, ny, nx)
    HL, at = take_matrix(at, ny, nx)
    S, at = take_matrix(at, ny, ny)
    U, at = take_matrix(at, ny, ny)
    e, at = take_vector(at, ny)
    seen, at = take_vector(at, ny)
    forward, at = take_vector(at, nx)
    z, at = take_vector(at, nx)
    xi, at = take_vector(at, nx)
    G, at = take_matrix(at, ny, ny)
    d, at = take_vector(at, ny)
    scratch, at = take_vector(at, scratch_size(nx, ny))
    return Room(F, T, L, C, H, HL, S, U, e, seen, forward, z, xi, G, d, scratch, at)


class Ahead(NamedTuple):
    """What follows the cloud's scratch: the particles' predictive log densities (N,), and where the rooms begin."""

    densities: Any
    rooms: int
    end: int


@layout
def ahead_at(at, nx, ny, n):
    """Lay it out."""
    densities, at = take_vector(at, n)
    return Ahead(densities, at, at + blocks_of(n) * room_at(0, nx, ny).end)


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: the cloud's, the predictive log densities, and a room for each block."""
    n = members(options)
    return size_of(work_at, nx, ny, n) + size_of(ahead_at, nx, ny, n)


@jit
def ahead_of(context, shared):
    """What follows the cloud's scratch."""
    return ahead_at(shared.end, context.nx, context.width, int(numbers(context)[MEMBERS]))


@jit
def room_of(context, shared, b):
    """The room of block b."""
    nx, ny = context.nx, context.width
    return room_at(ahead_of(context, shared).rooms + b * room_at(0, nx, ny).end, nx, ny)


@jit
def move_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Predict N(x, P) of a block's members; its first sum is how many became infinite or NaN."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    shared, cloud = work_of(context, work), cloud_of(state, nx, n)
    room = room_of(context, shared, number)
    records, log_w, forward = cloud.records, cloud.log_w, room.forward
    F, T, scratch = room.F, room.T, room.scratch
    circular = circular_states(context)
    first, last = range_of(number, n)
    lost = 0
    chances = np.empty(context.n_modes)
    for i in range(first, last):
        x = records[i, :nx]
        if context.jump != 0:
            jump(context, x, u, dt, jump_key(key), i, chances)
        P = own_covariance(records[i], nx)
        certain = True
        for j in range(nx):
            certain &= P[j, j] == 0.0
        if not certain:
            state_jacobian(context, x, u, dt, F, scratch)
            congruence(F, P, T)
        transition(context, x, u, dt, forward)
        add_process_noise(context, x, u, dt, P, T[:nx])
        finite = True
        for j in range(nx):
            finite &= np.isfinite(forward[j]) and np.isfinite(P[j, j])
        if finite:
            for j in range(nx):
                x[j] = forward[j]
            wrap_record(circular, x)
        else:
            log_w[i] = -np.inf
            lost += 1
            for j in range(nx):
                for k in range(nx):
                    P[j, k] = 0.0
    block_of(context, shared, number).sums[0] = lost


@jit
def look(context, sensor, u, y, x, P, L, H, HL, S, U, e, expected, scratch):
    """Residual e, L, H L and S = H P Hᵀ + R = Uᵀ U of one particle, over the finite rows; `expected` gets U⁻ᵀ e.

    Returns:
        log N(e; 0, S), or NaN if it has none.
    """
    nx = x.size
    r = sensor_variances(context, sensor)
    circular = circular_rows(context, sensor)
    expect(context, sensor, x, u, expected)
    sensor_jacobian(context, sensor, x, u, H, scratch)
    semidefinite_root(P, L)
    m = 0
    for row in range(r.size):
        if not np.isfinite(y[row]):
            continue
        e[m] = y[row] - expected[row]
        if circular[row] != 0:
            e[m] = wrap(e[m])
        for j in range(nx):
            s = 0.0
            for k in range(j, nx):
                s += H[row, k] * L[k, j]
            HL[m, j] = s
        for k in range(m + 1):
            s = 0.0
            for j in range(nx):
                s += HL[m, j] * HL[k, j]
            S[m, k] = s
            S[k, m] = s
        S[m, m] += r[row]
        expected[m] = e[m]
        m += 1
    if has_correlated_rows(context, sensor):
        add_covariances(context, sensor, y, 1.0, S)
    if not cholesky(S, U, m):
        return np.nan
    solve_transposed(U, m, expected)
    value = -0.5 * m * LOG_2PI
    for k in range(m):
        value -= 0.5 * expected[k] * expected[k] + np.log(U[k, k])
    return value


@jit
def expect_block(context, u, dt, sensor, y, key, value, state, work, number):
    """joint = log w + log N(y; h(x), H P Hᵀ + R), the second kept ahead, and the sums of residuals and S - R.

    The sums are about `first_residual`; with them those of the two tails of each row, see `score_rows`.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    shared, cloud = work_of(context, work), cloud_of(state, nx, n)
    room, sums = room_of(context, shared, number), block_of(context, shared, number).sums
    joint, ahead = shared.joint, ahead_of(context, shared).densities
    records, log_w = cloud.records, cloud.log_w
    H = room.H[: sensor_variances(context, sensor).size]
    L, HL, S, U, e, seen, scratch = room.L, room.HL, room.S, room.U, room.e, room.seen, room.scratch
    first, last = range_of(number, n)
    r = sensor_variances(context, sensor)
    own = has_own_likelihood(context, sensor)
    correlated = has_correlated_rows(context, sensor)
    equal = state[EQUAL] != 0.0
    circular = circular_rows(context, sensor)
    reference = np.empty(r.size)
    first_residual(context, u, sensor, y, records[0, :nx], reference)
    tails = tails_of(context, sums)
    for k in range(sums.size):
        sums[k] = 0.0
    sums[2] = -np.inf
    for i in range(first, last):
        x = records[i, :nx]
        P = own_covariance(records[i], nx)
        density = look(context, sensor, u, y, x, P, L, H, HL, S, U, e, seen, scratch)
        sound = density < np.inf and log_w[i] > -np.inf
        if own:
            density = own_likelihood(context, sensor, y, x, u)
        ahead[i] = density
        if not -np.inf < density < np.inf:
            density = -np.inf
        joint[i] = log_w[i] + density
        if joint[i] > sums[2]:
            sums[2] = joint[i]
            sums[3] = i
        if not sound:
            continue
        w = 1.0 if equal else np.exp(log_w[i])
        sums[0] += w
        m = 0
        for row in range(r.size):
            if np.isfinite(y[row]):
                e[m] = about(e[m], reference[row], circular[row])
                if not own:
                    add_tail((reference[row] + e[m]) / np.sqrt(S[m, m]), w, tails[2 * m :])
                S[m, m] -= r[row]
                m += 1
        if correlated:
            add_covariances(context, sensor, y, -1.0, S)
        for a in range(m):
            sums[4 + a] += w * e[a]
            for b in range(a + 1):
                sums[4 + m + a * m + b] += w * (e[a] * e[b] + S[a, b])


@inlined
def place_draw(context, sensor, u, y, x, L, z, G, d, seen):
    """x ← x + L z, certain of itself; returns log p(y | x)."""
    add_noise(L, z, x)
    wrap_record(circular_states(context), x)
    return log_density(context, sensor, u, y, x, G, d, seen)


@inlined
def settle_draw(P, value, i, joint, sums):
    """Member i has drawn: its covariance is zero, its joint log weight `value`, or zero weight if that is NaN."""
    for a in range(P.shape[0]):
        for b in range(P.shape[0]):
            P[a, b] = 0.0
    if not -np.inf < value < np.inf:
        value = -np.inf
    joint[i] = value
    if value > sums[2]:
        sums[2] = value
        sums[3] = i


@jit
def predict(context, u, dt, index, state, work):
    """N(x, P) of every particle one step on: x ← f(x), P ← F P Fᵀ + Q."""
    n = int(numbers(context)[MEMBERS])
    index = next_draw(state)
    sweep(MOVE, context, u, dt, 0, u, key_of(context.seed, index, PROCESS), 0.0, state, work)
    lost = add_up(context, work)[0]
    if lost > 0.0:
        state[EQUAL] = 0.0
        if lost >= n:
            recover(context, index, state)


@jit
def expected_reading(context, u, sensor, y, state, work, innovation, innovation_std, score):
    """What the particles' Gaussians say of the reading, and the verdict on it."""
    shared, cloud = work_of(context, work), cloud_of(state, context.nx, int(numbers(context)[MEMBERS]))
    settled = state[SETTLED]
    index = next_draw(state)
    sweep(EXPECT, context, u, 0.0, sensor, y, NO_KEY, 0.0, state, work)
    add_up(context, work)
    x = cloud.records[0, : context.nx]
    m = predicted(context, u, sensor, y, x, shared, innovation, innovation_std)
    state[SETTLED] = settled
    verdict = admit(context, sensor, m, shared.nu, shared.S, shared.U, score)
    score_rows(context, sensor, y, shared, score)
    return index, verdict
