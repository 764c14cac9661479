"""Particles that wait for the reading before they move: what `pf-ekf` and `apf` share.

Between readings a particle carries the Gaussian of where it may be, N(x, P): x ← f(x), and P ← F P Fᵀ + Q from P = 0
at the last reading. One step from a certain particle is the model's own transition, exactly; over several steps it is
the EKF's approximation of it. The reading then says where in that Gaussian the particle goes, and a weight corrects
for the choice: in coordinates z of P = L Lᵀ, x + L z, so that a singular P is no obstacle.
"""

from __future__ import annotations

from functools import lru_cache

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
from ..compiled.noise import add_noise, semidefinite_root
from ..compiled.verdict import LOG_2PI
from ..estimator import Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import address, floats, jit, matrix
from ..numerics.linalg import cholesky, congruence, solve_transposed, wrap
from ..numerics.random import ONE, key_of, normal
from ..tuning import Tuning
from .mode_draws import jump, jump_key
from .shared import (
    BLOCK,
    EQUAL,
    EXTRA,
    MEMBERS,
    PROCESS,
    blocks_of,
    log_weights,
    members,
    next_draw,
    records_of,
    recover,
    wrap_record,
)
from .steps import (
    OWN,
    about,
    block_count,
    block_signature,
    block_size,
    blocks_start,
    first_residual,
    shared,
    sums_size,
    sweep,
    total,
)
from .steps import tune as tune_cloud
from .steps import work_size as cloud_work_size

MOVE, EXPECT, PROPOSE_EKF, PROPOSE_PRIOR = range(OWN, OWN + 4)
"""Phases: N(x, P) one step on; what it says of the reading; a draw from the EKF's posterior; a draw from N(x, P)."""


def own_numbers(nx: int, ny: int) -> int:
    """Scratch of a block: F, twice its square, L, C; H, H L, S, U; e, ŷ, ν̃; x', z, ξ; a Jacobian's."""
    return 5 * nx * nx + 2 * ny * nx + 2 * ny * ny + 3 * ny + 3 * nx + scratch_size(nx, ny)


def work_size(options: dict[str, float], nx: int, ny: int) -> int:
    """Scratch: the cloud's, the predictive log densities (N,), and each block's own."""
    n = members(options)
    return cloud_work_size(options, nx, ny) + n + blocks_of(n) * own_numbers(nx, ny)


@lru_cache(maxsize=1)
def _own_code() -> float:
    return float(address(_block, block_signature))


def tune(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The cloud's numbers, and where the code of the phases above starts."""
    values = tune_cloud(options, model, tuning)
    values[EXTRA] = _own_code()
    return values


@jit
def predictive(context, work, n):
    """The predictive log densities (N,) that `EXPECT` leaves."""
    return floats(work.ctypes.data + 8 * (blocks_start(context, n) + block_count(n) * block_size(context)), n)


@jit
def _move(context, u, dt, key, log_w, records, first, last, F, T, forward, scratch):
    """Predict N(x, P) of the members `first` to `last`; return how many left the numbers."""
    nx = context.nx
    circular = circular_states(context)
    lost = 0
    chances = np.empty(context.n_modes)
    for i in range(first, last):
        x = records[i, :nx]
        if context.jump != 0:
            jump(context, x, u, dt, jump_key(key), i, chances)
        P = matrix(records[i], nx, nx, nx)
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
    return lost


@jit
def _see(context, sensor, u, y, x, P, L, H, HL, S, U, e, expected, scratch):
    """Residual e, L, H L and S = H P Hᵀ + R = Uᵀ U of one particle, over the finite rows.

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
    if not cholesky(S, U, m):
        return np.nan
    solve_transposed(U, m, expected)
    value = -0.5 * m * LOG_2PI
    for k in range(m):
        value -= 0.5 * expected[k] * expected[k] + np.log(U[k, k])
    return value


@jit
def _expect(context, sensor, u, y, state, joint, ahead, first, last, L, H, HL, S, U, e, expected, scratch, sums):
    """joint = log w + log N(y; h(x), H P Hᵀ + R), the second kept in `ahead`, and the sums of residuals and S - R.

    The sums are about `first_residual`.
    """
    nx = context.nx
    n = joint.size
    log_w = log_weights(state, nx, n)
    records = records_of(state, nx, n)
    r = sensor_variances(context, sensor)
    own = has_own_likelihood(context, sensor)
    equal = state[EQUAL] != 0.0
    circular = circular_rows(context, sensor)
    reference = np.empty(r.size)
    first_residual(context, u, sensor, y, records[0, :nx], reference)
    for k in range(sums.size):
        sums[k] = 0.0
    sums[2] = -np.inf
    for i in range(first, last):
        x = records[i, :nx]
        value = _see(context, sensor, u, y, x, matrix(records[i], nx, nx, nx), L, H, HL, S, U, e, expected, scratch)
        sound = value < np.inf and log_w[i] > -np.inf
        if own:
            value = own_likelihood(context, sensor, y, x, u)
        ahead[i] = value
        if not -np.inf < value < np.inf:
            value = -np.inf
        joint[i] = log_w[i] + value
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
                S[m, m] -= r[row]
                e[m] = about(e[m], reference[row], circular[row])
                m += 1
        for a in range(m):
            sums[4 + a] += w * e[a]
            for b in range(a + 1):
                sums[4 + m + a * m + b] += w * (e[a] * e[b] + S[a, b])


@jit
def _log_density(context, sensor, u, y, x, expected):
    """log p(y | x): Gaussian over the finite rows, or the sensor's own; -inf if it is no number."""
    if has_own_likelihood(context, sensor):
        value = own_likelihood(context, sensor, y, x, u)
    else:
        r = sensor_variances(context, sensor)
        circular = circular_rows(context, sensor)
        expect(context, sensor, x, u, expected)
        value = 0.0
        for row in range(r.size):
            if np.isfinite(y[row]):
                d = y[row] - expected[row]
                if circular[row] != 0:
                    d = wrap(d)
                value -= 0.5 * (d * d / r[row] + LOG_2PI + np.log(r[row]))
    return value if -np.inf < value < np.inf else -np.inf


@jit
def _propose(
    context, sensor, u, y, key, ekf, state, joint, ahead, first, last, L, C, H, HL, S, U, e, expected, z, xi, scratch,
    sums,
):  # fmt: skip
    """Move the members `first` to `last` into the reading and set their joint log weights.

    EKF: z ~ N(ẑ, Σ) with ẑ = (H L)ᵀ S⁻¹ e, Σ = I - (H L)ᵀ S⁻¹ H L, and the weight
    w' p(y | x) N(z; 0, I) / N(z; ẑ, Σ). Otherwise z ~ N(0, I), and the weight p(y | x) / p̂(y), with the predictive
    density by which the particle was chosen.
    """
    nx = context.nx
    n = joint.size
    log_w = log_weights(state, nx, n)
    records = records_of(state, nx, n)
    circular = circular_states(context)
    place = np.uint64(first) * np.uint64(nx)
    finite_rows = 0
    for row in range(sensor_variances(context, sensor).size):
        finite_rows += np.isfinite(y[row])
    sums[2] = -np.inf
    for i in range(first, last):
        x = records[i, :nx]
        P = matrix(records[i], nx, nx, nx)
        correction = 0.0
        sound = True
        if ekf:
            seen = _see(context, sensor, u, y, x, P, L, H, HL, S, U, e, expected, scratch)
            # Where h or its slope is no number there is no proposal: the particle stays and weighs nothing.
            sound = -np.inf < seen < np.inf
            # HL becomes U⁻ᵀ H L, `expected` holds U⁻ᵀ e.
            for k in range(finite_rows):
                for j in range(nx):
                    HL[k, j] /= U[k, k]
                    for below in range(k + 1, finite_rows):
                        HL[below, j] -= U[k, below] * HL[k, j]
            for a in range(nx):
                z[a] = 0.0
                for k in range(finite_rows):
                    z[a] += HL[k, a] * expected[k]
                for b in range(a + 1):
                    s = 1.0 if a == b else 0.0
                    for k in range(finite_rows):
                        s -= HL[k, a] * HL[k, b]
                    P[a, b] = s
            semidefinite_root(P, C)
            for a in range(nx):
                xi[a] = normal(key, place)
                place += ONE
                correction += 0.5 * xi[a] * xi[a] + np.log(C[a, a])
            add_noise(C, xi, z)
            for a in range(nx):
                correction -= 0.5 * z[a] * z[a]
        else:
            semidefinite_root(P, L)
            for a in range(nx):
                z[a] = normal(key, place)
                place += ONE
        for a in range(nx):
            sound &= np.isfinite(z[a])
        value = -np.inf
        if sound:
            add_noise(L, z, x)
            wrap_record(circular, x)
            value = _log_density(context, sensor, u, y, x, expected)
            value += log_w[i] + (correction if ekf else -ahead[i])
        for a in range(nx):
            for b in range(nx):
                P[a, b] = 0.0
        if not -np.inf < value < np.inf:
            value = -np.inf
        joint[i] = value
        if value > sums[2]:
            sums[2] = value
            sums[3] = i


@jit
def _block(phase, context, u, dt, sensor, y, key, value, state, work, b):
    nx, ny = context.nx, context.width
    n = int(numbers(context)[MEMBERS])
    first, last = b * BLOCK, min(n, (b + 1) * BLOCK)
    joint = floats(work.ctypes.data + 8 * n, n)
    ahead = predictive(context, work, n)
    sums = floats(work.ctypes.data + 8 * (blocks_start(context, n) + b * block_size(context)), sums_size(context))
    most = max(nx, ny)
    own = 5 * nx * nx + 2 * ny * nx + 2 * ny * ny + 3 * ny + 3 * nx + 2 * nx + 2 * most
    at = blocks_start(context, n) + block_count(n) * block_size(context) + n + b * own
    F = matrix(work, at, nx, nx)
    at += nx * nx
    T = matrix(work, at, 2 * nx, nx)
    at += 2 * nx * nx
    L = matrix(work, at, nx, nx)
    at += nx * nx
    C = matrix(work, at, nx, nx)
    at += nx * nx
    m = sensor_variances(context, sensor).size
    H = matrix(work, at, m, nx)
    at += ny * nx
    HL = matrix(work, at, m, nx)
    at += ny * nx
    S = matrix(work, at, m, m)
    at += ny * ny
    U = matrix(work, at, m, m)
    at += ny * ny
    e = floats(work.ctypes.data + 8 * at, m)
    expected = floats(work.ctypes.data + 8 * (at + ny), m)
    at += 3 * ny
    forward = floats(work.ctypes.data + 8 * at, nx)
    z = floats(work.ctypes.data + 8 * (at + nx), nx)
    xi = floats(work.ctypes.data + 8 * (at + 2 * nx), nx)
    at += 3 * nx
    scratch = floats(work.ctypes.data + 8 * at, 2 * nx + 2 * most)
    if phase == MOVE:
        sums[0] = _move(
            context,
            u,
            dt,
            key,
            log_weights(state, nx, n),
            records_of(state, nx, n),
            first,
            last,
            F,
            T,
            forward,
            scratch,
        )
    elif phase == EXPECT:
        _expect(context, sensor, u, y, state, joint, ahead, first, last, L, H, HL, S, U, e, expected, scratch, sums)
    else:
        _propose(
            context, sensor, u, y, key, phase == PROPOSE_EKF, state, joint, ahead, first, last, L, C, H, HL, S, U, e,
            expected, z, xi, scratch, sums,
        )  # fmt: skip


@jit
def predict(context, u, dt, index, state, work):
    """N(x, P) of every particle one step on: x ← f(x), P ← F P Fᵀ + Q."""
    n = int(numbers(context)[MEMBERS])
    index = next_draw(state)
    sums, _, _, _, _, _, _ = shared(context, work, n)
    sweep(MOVE, context, u, dt, 0, u, key_of(context.seed, index, PROCESS), 0.0, state, work)
    total(context, work, sums)
    if sums[0] > 0.0:
        state[EQUAL] = 0.0
        if sums[0] >= n:
            recover(context, index, state)
