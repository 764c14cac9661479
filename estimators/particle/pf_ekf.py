"""The particle filter with an EKF proposal: each particle moves by its own EKF step into the measurement.

x_i ~ q = N(x; EKF posterior of particle i),  w_i ∝ w_i' p(y | x_i) p(x_i | x_i') / q(x_i). With a linear sensor and one
step between measurements q is the optimal proposal p(x | x', y), and the weight does not depend on the draw.

Sources: van der Merwe, Doucet, de Freitas & Wan (2000), The unscented particle filter, for the EKF as proposal; Doucet,
Godsill & Andrieu (2000), doi:10.1023/A:1008935410038, for the optimal proposal and its weight.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import sensor_variances
from ..compiled.noise import add_noise, independent_rows, semidefinite_root
from ..estimator import Estimator
from ..numerics.jit import inlined, jit
from ..numerics.linalg import EPSILON
from ..numerics.random import ONE, key_of, normal
from ..track import FAILED, MISSING, USED
from .cloud import DRAW, count_of, describe, own_cloud, own_covariance
from .draws import recover, start
from .innovation import expected_reading, finite_rows
from .pf import conclude
from .proposals import (
    EXPECT,
    PROPOSE,
    WAITING,
    expect_block,
    innovation_log_density,
    move_block,
    place_draw,
    predict,
    room_of,
    settle_draw,
)
from .weights import add_up, block_of, phases, range_of, sweep, work_of


@jit
def propose_block(context, u, dt, sensor, y, key, value, state, work, number):
    """Draw each member from its EKF's posterior and set its joint log weight.

    In coordinates z of P = L Lᵀ: z ~ N(ẑ, Σ) with ẑ = (H L)ᵀ S⁻¹ e, Σ = I - (H L)ᵀ S⁻¹ H L, and the weight
    w' p(y | x) N(z; 0, I) / N(z; ẑ, Σ).
    """
    nx, n = context.nx, count_of(context)
    shared, cloud = work_of(context, work), own_cloud(context, state)
    room, sums = room_of(context, shared, number), block_of(context, shared, number).sums
    L, C, z, xi, HL, S, U = room.L, room.C, room.z, room.xi, room.HL, room.S, room.U
    G, d, e, seen, scratch = room.G, room.d, room.e, room.seen, room.scratch
    r = sensor_variances(context, sensor)
    H = room.H[: r.size]
    m = independent_rows(context, sensor, y, r, G, d)
    records, log_w, joints = cloud.records, cloud.log_w, shared.joint
    first, last = range_of(number, n)
    place = np.uint64(first) * np.uint64(nx)
    sums[2] = -np.inf
    for i in range(first, last):
        x, P = records[i, :nx], own_covariance(records[i], nx)
        density = innovation_log_density(context, sensor, u, y, x, P, L, H, HL, S, U, e, seen, scratch)
        # Where h or its slope is NaN there is no proposal: the particle stays and gets weight zero.
        sound = -np.inf < density < np.inf
        posterior(m, HL, U, seen, z, P)
        semidefinite_root(P, C)
        ratio = 0.0
        for a in range(nx):
            xi[a] = normal(key, place)
            # A variance that rounds to zero would leave no density.
            C[a, a] = max(C[a, a], np.sqrt(EPSILON))
            place += ONE
            ratio += 0.5 * xi[a] * xi[a] + np.log(C[a, a])
        add_noise(C, xi, z)
        for a in range(nx):
            ratio -= 0.5 * z[a] * z[a]
        for a in range(nx):
            sound &= np.isfinite(z[a])
        joint = -np.inf
        if sound:
            joint = place_draw(context, sensor, u, y, x, L, z, G, d, seen)
            joint += log_w[i] + ratio
        settle_draw(P, joint, i, joints, sums)


@inlined
def posterior(m, HL, U, seen, z, P):
    """Fill z = ẑ and the lower triangle of P = Σ from the results of `innovation_log_density`; H L becomes U⁻ᵀ H L."""
    nx = z.size
    for k in range(m):
        for j in range(nx):
            HL[k, j] /= U[k, k]
            for below in range(k + 1, m):
                HL[below, j] -= U[k, below] * HL[k, j]
    for a in range(nx):
        z[a] = 0.0
        for k in range(m):
            z[a] += HL[k, a] * seen[k]
        for b in range(a + 1):
            s = 1.0 if a == b else 0.0
            for k in range(m):
                s -= HL[k, a] * HL[k, b]
            P[a, b] = s


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Draw each particle from its EKF posterior, weigh it, resample where few carry the weight.

    The log-likelihood of a held-out measurement is that of the particles' Gaussians, Σ w' N(y; h(x), S).
    """
    if finite_rows(y, sensor_variances(context, sensor).size) == 0:
        return MISSING
    index, verdict = expected_reading(EXPECT, context, u, sensor, y, state, work, innovation, innovation_std, score)
    if verdict == USED:
        # x_i ~ q, log w_i + log p(y | x_i) p(x_i | x_i') / q(x_i)
        sweep(PROPOSE, context, u, 0.0, sensor, y, key_of(context.seed, index, DRAW), 0.0, state, work)
        add_up(context, work)
    verdict = conclude(context, index, verdict, state, work, score)
    if verdict == FAILED:
        recover(context, index, state)
    return verdict


PF_EKF = Estimator(
    name="pf-ekf",
    title="Particle filter with EKF proposal",
    assumes="as pf; f and h differentiable, the noise of a step Gaussian",
    model_runs="3 N, and the derivatives of h (of f too between readings of several steps)",
    fails_when="the EKF's posterior of a particle misses where the reading puts it",
    source="van der Merwe, Doucet, de Freitas & Wan (2000), The unscented particle filter",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: 3 * options["particles"],
    prepare=phases(move_block, expect_block, propose_block),
    considers=True,
    **WAITING,
)
