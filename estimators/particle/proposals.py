"""Particles that wait for the measurement before they move: shared by `pf-ekf` and `apf`.

Between measurements a particle carries the Gaussian of its next state, N(x, P): x ← f(x), and P ← F P Fᵀ + Q from P = 0
at the last measurement. One step from a certain particle is the model's own transition, exactly; over several steps it
is the EKF's approximation of it. The measurement then decides where in that Gaussian the particle goes, and a weight
corrects for the choice: in coordinates z of P = L Lᵀ, x + L z, so that a singular P is allowed.
"""

from __future__ import annotations

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
from ..compiled.jacobians import scratch_size, sensor_jacobian, state_jacobian
from ..compiled.noise import add_covariances, add_noise, semidefinite_root
from ..compiled.verdict import LOG_2PI
from ..numerics.jit import inlined, jit
from ..numerics.linalg import cholesky, congruence, solve_transposed, wrap
from ..numerics.random import key_of
from ..numerics.workspace import declare_layout, take_vector
from .cloud import (
    EQUAL,
    PROCESS,
    SHARED,
    clear_sums,
    count_of,
    next_draw,
    own_cloud,
    own_covariance,
    sized,
    wrap_record,
)
from .draws import jump, jump_key, recover
from .innovation import add_gaussian, first_residual, log_density
from .weights import OWN, all_lost, block_of, members_own, range_of, sweep, work_of, work_sized

MOVE, EXPECT, PROPOSE = range(OWN, OWN + 3)
"""Phases: N(x, P) one step on; its prediction of the measurement; the filter's own draw."""


ProposalRoom, room_at = declare_layout(
    "ProposalRoom",
    "nx, ny",
    scratch_size,
    F="nx, nx",
    T="2 * nx, nx",
    L="nx, nx",
    C="nx, nx",
    H="ny, nx",
    HL="ny, nx",
    S="ny, ny",
    U="ny, ny",
    e="ny",
    seen="ny",
    forward="nx",
    z="nx",
    xi="nx",
    G="ny, ny",
    d="ny",
    scratch="scratch_size(nx, ny)",
)
"""Scratch of a block for one particle: F and T for F P Fᵀ; roots L and C; H and H L, S and its factor U, residual e and
U⁻ᵀ e of the predicted measurement; next state, z and ξ; R = G diag(d) Gᵀ of the finite rows; scratch of a Jacobian."""


work_size = work_sized(room_at, lambda nx: 1)


@jit
def densities_of(context, shared):
    """Return the particles' predictive log densities (N,)."""
    densities, _ = take_vector(shared.end, count_of(context))
    return densities


@jit
def room_of(context, shared, b):
    """Return the room of block b."""
    nx, ny = context.nx, context.width
    _, rooms = members_own(context, shared, 1)
    return room_at(rooms + b * room_at(0, nx, ny).end, nx, ny)


@jit
def move_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Predict N(x, P) of a block's members; its first sum is how many became infinite or NaN."""
    nx, n = context.nx, count_of(context)
    shared, cloud = work_of(context, work), own_cloud(context, state)
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
            congruence(F, P.shape[0], P, T)
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
            P[:] = 0.0
    block_of(context, shared, number).sums[0] = lost


@jit
def innovation_log_density(context, sensor, u, y, x, P, L, H, HL, S, U, e, expected, scratch):
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
    """joint = log w + log N(y; h(x), H P Hᵀ + R), the second also kept, and the sums of residuals and S - R.

    The sums are about `first_residual` and include the two tails of each row, see `score_rows`.
    """
    nx, n = context.nx, count_of(context)
    shared, cloud = work_of(context, work), own_cloud(context, state)
    room, sums = room_of(context, shared, number), block_of(context, shared, number).sums
    joint, ahead = shared.joint, densities_of(context, shared)
    records, log_w = cloud.records, cloud.log_w
    H = room.H[: sensor_variances(context, sensor).size]
    L, HL, S, U, e, seen, scratch = room.L, room.HL, room.S, room.U, room.e, room.seen, room.scratch
    first, last = range_of(number, n)
    r = sensor_variances(context, sensor)
    own = has_own_likelihood(context, sensor)
    equal = state[EQUAL] != 0.0
    reference = np.empty(r.size)
    first_residual(context, u, sensor, y, records[0, :nx], reference)
    clear_sums(sums)
    for i in range(first, last):
        x = records[i, :nx]
        P = own_covariance(records[i], nx)
        density = innovation_log_density(context, sensor, u, y, x, P, L, H, HL, S, U, e, seen, scratch)
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
        if sound:
            add_gaussian(context, sensor, y, 1.0 if equal else np.exp(log_w[i]), reference, e, S, sums)


@inlined
def place_draw(context, sensor, u, y, x, L, z, G, d, seen):
    """x ← x + L z, from now on certain; return log p(y | x)."""
    add_noise(L, z, x)
    wrap_record(circular_states(context), x)
    return log_density(context, sensor, u, y, x, G, d, seen)


@inlined
def settle_draw(P, value, i, joint, sums):
    """Set the covariance of a drawn member to zero, and its joint log weight to `value`, or -inf if that is NaN."""
    P[:] = 0.0
    if not -np.inf < value < np.inf:
        value = -np.inf
    joint[i] = value
    if value > sums[2]:
        sums[2] = value
        sums[3] = i


@jit
def predict(context, u, dt, index, state, work):
    """N(x, P) of every particle one step on: x ← f(x), P ← F P Fᵀ + Q."""
    index = next_draw(state)
    sweep(MOVE, context, u, dt, 0, u, key_of(context.seed, index, PROCESS), 0.0, state, work)
    if all_lost(context, state, work):
        recover(context, index, state)


WAITING = {**SHARED, "state_size": sized(lambda nx: nx + nx * nx), "work_size": work_size}
"""Fields of an `Estimator` that the filters whose particles wait share."""
