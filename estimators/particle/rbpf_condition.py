"""The update of the Rao-Blackwellised filter: each particle a Kalman update, and the mixture of their predictions."""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_rows, circular_states, expect, linear_states, sensor_variances
from ..compiled.context import options as numbers
from ..compiled.jacobians import sensor_jacobian
from ..compiled.noise import add_covariances
from ..compiled.verdict import LOG_2PI
from ..gaussian.shared import factor
from ..numerics.jit import jit
from ..numerics.linalg import solve_transposed, wrap
from ..numerics.normal_score import add_tail
from .cloud import EQUAL, MEMBERS, cloud_of, own_covariance, wrap_record
from .innovation import about, finite_rows
from .moments import tails_of
from .rbpf_work import aside_of, room_of
from .steps import block_of, range_of, work_of


@jit
def condition_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Condition a block's members on the reading, aside: a Kalman update of each one's linear part.

    x ← x + K e;  P ← P - K S Kᵀ;  joint = log w + log N(e; 0, S),  S = H P Hᵀ + R, over the finite rows. The sums get
    the moments of the predicted reading, about the reference, under the weights before it, and its two tails, row by
    row; see `score_rows`.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    shared, cloud = work_of(context, work), cloud_of(state, nx, n)
    room, sums = room_of(context, shared, number), block_of(context, shared, number).sums
    B, S, U, e, expected = room.B, room.S, room.U, room.e, room.expected
    joint, reference, after = shared.joint, shared.nu, aside_of(context, shared).posteriors
    records, log_w = cloud.records, cloud.log_w
    first, last = range_of(number, n)
    linear = linear_states(context)
    r = sensor_variances(context, sensor)
    H = room.H[: r.size]
    angles = circular_rows(context, sensor)
    circular = circular_states(context)
    equal = state[EQUAL] != 0.0
    for k in range(sums.size):
        sums[k] = 0.0
    sums[2] = -np.inf
    tails = tails_of(context, sums)
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
        add_covariances(context, sensor, y, 1.0, S)
        if not factor(S, U, m, nx):
            continue
        w = 1.0 if equal else np.exp(log_w[i])
        sums[0] += w
        k = 0
        for row in range(r.size):
            if np.isfinite(y[row]):
                z = about(y[row], reference[row], angles[row]) - expected[k] if angles[row] != 0 else e[k]
                add_tail(z / np.sqrt(S[k, k]), w, tails[2 * k :])
                k += 1
        for a in range(m):
            sums[4 + a] += w * expected[a]
            for b in range(a + 1):
                sums[4 + m + a * m + b] += w * (expected[a] * expected[b] + S[a, b])
        solve_transposed(U, m, e)
        density = log_w[i] - 0.5 * m * LOG_2PI
        for k in range(m):
            density -= 0.5 * e[k] * e[k] + np.log(U[k, k])
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
    """Make the posteriors of the members that have one their own."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    shared, records = work_of(context, work), cloud_of(state, nx, n).records
    posteriors = aside_of(context, shared).posteriors
    first, last = range_of(number, n)
    for i in range(first, last):
        if shared.joint[i] > -np.inf:
            for j in range(nx + nx * nx):
                records[i, j] = posteriors[i, j]


@jit
def refer(context, sensor, u, state, reference):
    """What the first particle that can tell expects of the sensor: close to what all do, as a place to sum from."""
    n = int(numbers(context)[MEMBERS])
    records = cloud_of(state, context.nx, n).records
    for i in range(n):
        expect(context, sensor, records[i, : context.nx], u, reference)
        finite = True
        for k in range(reference.size):
            finite &= np.isfinite(reference[k])
        if finite:
            return
    for k in range(reference.size):
        reference[k] = 0.0


@jit
def mixture(context, sensor, y, shared, innovation, innovation_std):
    """Innovation and its covariance, those of the mixture of the particles' predictions; ν holds the reference.

    ν = y - Σ w ŷ,  S = Σ w (S_i + ŷ ŷᵀ) - (Σ w ŷ)(Σ w ŷ)ᵀ

    Returns:
        The number of finite rows.
    """
    sums, S, nu = shared.sums, shared.S, shared.nu
    r = sensor_variances(context, sensor)
    angles = circular_rows(context, sensor)
    m = finite_rows(y, r.size)
    k = 0
    for row in range(r.size):
        if not np.isfinite(y[row]):
            continue
        shift = sums[4 + k] / sums[0]
        # Row `row` moves up to k ≤ row.
        nu[k] = y[row] - nu[row] - shift
        if angles[row] != 0:
            nu[k] = wrap(nu[k])
        for j in range(k + 1):
            S[k, j] = sums[4 + m + k * m + j] / sums[0] - shift * sums[4 + j] / sums[0]
            S[j, k] = S[k, j]
        S[k, k] = max(S[k, k], r[row])
        innovation[row] = nu[k]
        innovation_std[row] = np.sqrt(S[k, k])
        k += 1
    return m
