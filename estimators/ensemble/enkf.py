"""The stochastic ensemble Kalman filter: each member is corrected by a reading perturbed for it alone.

    xᵢ ← xᵢ + K (y + vᵢ - h(xᵢ)),   K = C_xy (C_yy + R)⁻¹,   vᵢ ~ N(0, R)

with the covariances of the members. The perturbations have mean zero over the members, so that the mean is updated
with the reading itself; without them the spread would become too small.

Sources: Evensen (1994), doi:10.1029/94JC00572; Burgers, van Leeuwen & Evensen (1998),
doi:10.1175/1520-0493(1998)126<1719:ASITEK>2.0.CO;2; Evensen (2003), doi:10.1007/s10236-003-0036-9. Localisation of
both covariances: Houtekamer & Mitchell (2001), doi:10.1175/1520-0493(2001)129<0123:ASEKFF>2.0.CO;2.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..compiled.context import sensor_rows
from ..estimator import Estimator
from ..numerics.jit import jit
from ..numerics.random import key_of, normal
from ..numerics.simd import add_scaled
from ..numerics.symmetric import solve_rows
from ..track import USED
from .blocks import sweep_all, transform_all
from .localisation import localised, prepare
from .shared import (
    ADD,
    CREWS,
    INFLATE,
    INFLATION,
    MEMBERS,
    PERTURB,
    RADIUS,
    add_spread,
    block,
    describe,
    ensemble,
    find_rows,
    judge,
    moments,
    next_draw,
    observe,
    points,
    predict,
    settle,
    start,
    state_size,
    tune,
    work_size,
    workspace,
)


@jit
def perturbed_innovations(seed, index, m, ZT, d, B):
    """B[k, i] = (y + vᵢ - h(xᵢ))ₖ / √rₖ, with vᵢ of mean zero over the members.

    Their sample variance, Σ v² / (N - 1) like the members' own, is r on average with no further scaling: so the spread
    of the analysis is (I - K H) P (I - K H)ᵀ + K R Kᵀ on average, which is Kalman's.
    """
    N = ZT.shape[1]
    key = key_of(seed, index, PERTURB)
    for k in range(m):
        total = 0.0
        for i in range(N):
            B[k, i] = normal(key, np.uint64(k * N + i))
            total += B[k, i]
        for i in range(N):
            B[k, i] = d[k] + (B[k, i] - total / N) - np.sqrt(N - 1.0) * ZT[k, i]


@jit
def weights(m, ZT, Z, B, U, T, W, inflation):
    """W (N, N + 1) with x̄ + W A the updated members: W = I + ((I + Z Zᵀ)⁻¹ Z B)ᵀ / √(N - 1)."""
    N = ZT.shape[1]
    if m <= N:
        solve_rows(U, m, B, N)
    for j in range(N):
        for i in range(N):
            T[j, i] = 0.0
        for k in range(m):
            add_scaled(N, Z[j, k], B[k].ctypes.data, T[j].ctypes.data)
    if m > N:
        solve_rows(U, N, T, N)
    scale = 1.0 / np.sqrt(N - 1.0)
    for j in range(N):
        total = 0.0
        for i in range(N):
            T[j, i] *= scale
            total += T[j, i]
        common = (total + 1.0) / N
        # The weights' mean over the members moves the mean, the rest are anomalies.
        for i in range(N):
            own = T[j, i] + (1.0 if i == j else 0.0)
            W[i, j] = common + inflation * (own - common)
    for i in range(N):
        W[i, N] = 1.0


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Condition the ensemble on a reading; see the module's equations.

    Moments are right on average over the perturbations; those of one analysis scatter by 1/√N. The spread collapses
    over many readings where members are few, unless it is inflated.
    """
    X = ensemble(context, state)
    N = X.shape[0]
    _, ny = sensor_rows(context, sensor)
    local = localised(context)
    parts = workspace(N, ny, ny if local else min(ny, N), work)
    ZT, Z, B, G, U, _, W, T, d, rows, expected, v, where, _, _, rest = parts
    m = observe(context, sensor, u, y, X, ZT, d, rows, expected, innovation, innovation_std)
    verdict = judge(context, sensor, m, ZT, Z, d, rows, G, U, v, score)
    if verdict != USED:
        return verdict
    index = next_draw(X, state)
    given = numbers(context)
    crews = int(given[CREWS])
    perturbed_innovations(context.seed, index, m, ZT, d, B)
    if local:
        solve_rows(U, m, B, N)
        scale = 1.0 / np.sqrt(N - 1.0)
        for k in range(m):
            total = 0.0
            for i in range(N):
                total += B[k, i]
            for i in range(N):
                B[k, i] = (B[k, i] - total / N) * scale
            B[k, N] = total / N * scale
        find_rows(m, rows, where)
        sweep_all(context, sensor, X, where, ZT, B, False, given[INFLATION], crews, rest)
    else:
        weights(m, ZT, Z, B, U, T, W, given[INFLATION])
        transform_all(X, W, crews, rest)
    add_spread(context, index, X, rest)
    settle(context, X)
    return USED


ENKF = Estimator(
    name="enkf",
    title="Stochastic ensemble Kalman filter",
    family="ensemble",
    assumes="posterior near Gaussian, its spread within the span of the members",
    model_runs="members",
    fails_when="few members: chance covariances, and the chance of the perturbations; the spread collapses",
    source="Burgers, van Leeuwen & Evensen (1998), doi:10.1175/1520-0493(1998)126<1719:ASITEK>2.0.CO;2",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["members"],
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    points=points,
    options=(MEMBERS, INFLATE, ADD, RADIUS),
    tune=tune,
    prepare=prepare,
    blocks=block,
)
