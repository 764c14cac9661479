"""The prediction of the Rao-Blackwellised filter: draws, and a Kalman prediction given them.

Source: Schön, Gustafsson & Nordlund (2005), doi:10.1109/TSP.2005.849151, theorem 1 and algorithm 1, step 4.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import add_process_noise, circular_states, linear_states, sampled_states, transition
from ..compiled.context import options as numbers
from ..compiled.jacobians import state_jacobian
from ..numerics.jit import jit
from .cloud import MEMBERS, cloud_of, own_covariance, wrap_record
from .mode_draws import jump, jump_key
from .rbpf_sampling import drop, sample
from .rbpf_work import room_of
from .steps import block_of, range_of, work_of


@jit
def lose(log_w, P, i):
    """A particle that became infinite or NaN gets weight zero."""
    log_w[i] = -np.inf
    for j in range(P.shape[0]):
        for k in range(P.shape[0]):
            P[j, k] = 0.0


@jit
def predict_block(context, u, dt, sensor, y, key, value, state, work, number):
    """One step of a block's members: m ~ chances, x ← f(x), P ← F P Fᵀ + Q, and the sampled states drawn.

    The block's first sum is how many were lost.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    shared, cloud = work_of(context, work), cloud_of(state, nx, n)
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
            for a in range(nx):
                for b in range(nx):
                    Q[a, b] = 0.0
            add_process_noise(context, x, u, dt, Q, T)
        transition(context, x, u, dt, forward)
        for a in range(nx):
            for b in range(nx):
                C[a, b] = Q[a, b]
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
            lose(log_w, P, i)
            lost += 1
            continue
        for a in range(nx):
            x[a] = forward[a]
            for b in range(nx):
                P[a, b] = C[a, b]
        wrap_record(circular, x)
    block_of(context, shared, number).sums[0] = lost
