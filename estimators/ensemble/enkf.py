"""The stochastic ensemble Kalman filter: each member is corrected by its own perturbed measurement.

    xᵢ ← xᵢ + K (y + vᵢ - h(xᵢ)),   K = C_xy (C_yy + R)⁻¹,   vᵢ ~ N(0, R)

with the covariances of the members. The perturbations have mean zero over the members, so that the mean is updated
with the measurement itself; without them the spread would become too small.

Members keep their considered states: K has no rows for them. As every member of the other states moves by the gain of
its own measurement, the covariance with them is then that of Schmidt's filter, on average, which a deterministic
analysis would have to restore (Schmidt, 1966; gaussian/shared.py).

Sources: Evensen (1994), doi:10.1029/94JC00572; Burgers, van Leeuwen & Evensen (1998),
doi:10.1175/1520-0493(1998)126<1719:ASITEK>2.0.CO;2; Evensen (2003), doi:10.1007/s10236-003-0036-9. Localisation of
both covariances: Houtekamer & Mitchell (2001), doi:10.1175/1520-0493(2001)129<0123:ASEKFF>2.0.CO;2.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import estimated
from ..compiled.context import options as numbers
from ..numerics.jit import jit
from ..numerics.random import key_of, normal
from ..numerics.simd import add_scaled
from ..numerics.symmetric import solve_rows
from ..track import USED
from .analysis import begin_analysis, find_places, work_size
from .blocks import regress_all, transform_all
from .localisation import localised, prepare
from .shared import CREWS, INFLATION, PERTURB, RADIUS, describe, ensemble_filter, finish, next_draw, predict, start


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
def weights(m, a, inflation):
    """W (N, N + 1) with x̄ + W A the updated members: W = I + ((I + Z Zᵀ)⁻¹ Z B)ᵀ / √(N - 1)."""
    ZT, Z, B, U, T, W = a.ZT, a.Z, a.B, a.U, a.T, a.W
    N = ZT.shape[1]
    if m <= N:
        solve_rows(U, m, B, N)
    T[:] = 0.0
    for j in range(N):
        for k in range(m):
            add_scaled(N, Z[j, k], B[k], T[j])
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
    W[:, N] = 1.0


@jit
def gains(m, a):
    """Turn B[k, i] into the factor of a covariance with row k on anomaly i, B[k, N] into that on the mean."""
    B, N = a.B, a.ZT.shape[1]
    solve_rows(a.U, m, B, N)
    scale = 1.0 / np.sqrt(N - 1.0)
    for k in range(m):
        total = 0.0
        for i in range(N):
            total += B[k, i]
        for i in range(N):
            B[k, i] = (B[k, i] - total / N) * scale
        B[k, N] = total / N * scale
    find_places(m, a.rows, a.places)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Condition the ensemble on a measurement; see the module's equations.

    Moments are right on average over the perturbations; those of one analysis scatter by 1/√N. The spread collapses
    over many measurements where members are few, unless it is inflated.
    """
    X, a, rest, m, verdict = begin_analysis(context, u, sensor, y, state, work, innovation, innovation_std, score)
    if verdict != USED:
        return verdict
    index = next_draw(context, state)
    given = numbers(context)
    crews = int(given[CREWS])
    # B = R^(-1/2) (y + vᵢ - h(xᵢ)), then xᵢ ← xᵢ + C_xy R^(-1/2) (I + Zᵀ Z)⁻¹ B, tapered or in the members' space.
    perturbed_innovations(context.seed, index, m, a.ZT, a.d, a.B)
    considered = X[:, estimated(context) :].copy()
    if localised(context):
        gains(m, a)
        regress_all(context, sensor, X, a.places, a.ZT, a.B, False, given[INFLATION], crews, rest)
    else:
        weights(m, a, given[INFLATION])
        transform_all(X, a.W, crews, rest)
    X[:, estimated(context) :] = considered
    finish(context, index, X, rest)
    return USED


ENKF = ensemble_filter(
    RADIUS,
    name="enkf",
    title="Stochastic ensemble Kalman filter",
    assumes="posterior near Gaussian, its spread within the span of the members",
    fails_when="few members: chance covariances, and the chance of the perturbations; the spread collapses",
    source="Burgers, van Leeuwen & Evensen (1998), doi:10.1175/1520-0493(1998)126<1719:ASITEK>2.0.CO;2",
    functions=(start, predict, update, describe),
    work_size=work_size,
    prepare=prepare,
    considers=True,
)
