"""The ensemble transform Kalman filter: all members are transformed at once so that their moments are the posterior's.

In whitened anomalies Z (N, m) of the expected measurement and d of the measurement itself (see analysis.py),

    x̄ ← x̄ + Aᵀ w,   w = (I + Z Zᵀ)⁻¹ Z d / √(N - 1);      A ← T A,   T = (I + Z Zᵀ)^(-1/2)

with the symmetric root, which changes the members least and keeps their mean. The transform is computed in the space of
the members; the states follow in one product.

Sources: Bishop, Etherton & Majumdar (2001), doi:10.1175/1520-0493(2001)129<0420:ASWTET>2.0.CO;2; Hunt, Kostelich &
Szunyogh (2007), doi:10.1016/j.physd.2006.11.008; Sakov & Oke (2008), doi:10.1175/2007MWR2021.1 (symmetric root and
rotations that keep the mean).
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..numerics.jit import jit
from ..numerics.simd import add_scaled
from ..numerics.symmetric import gram, symmetric_eigen
from ..track import FAILED, USED
from .analysis import begin_analysis, reconsider, work_size
from .blocks import ROTATION, identity, transform_members
from .shared import INFLATION, describe, ensemble_filter, finish, next_draw, predict, start


@jit
def symmetric_transform(m, a):
    """Fill T = (I + Z Zᵀ)^(-1/2) and v = √(N - 1) w, from the eigenvectors of Zᵀ Z or Z Zᵀ, whichever is smaller.

    With Zᵀ Z = V Λ Vᵀ,  T = I - Z V φ(Λ) Vᵀ Zᵀ,  φ(λ) = (1 - 1/√(1+λ))/λ = 1 / (1 + λ + √(1+λ)), which is regular at 0.

    Args:
        m: Rows of the measurement.
        a: The analysis, after `observe`; gets T and v.

    Returns:
        False if a number is not finite.
    """
    ZT, Z, d, G, V, values, small, v, B, T = a.ZT, a.Z, a.d, a.G, a.V, a.values, a.small, a.v, a.B, a.T
    N = ZT.shape[1]
    if m < N:
        identity(T, v)
        gram(Z, N, m, G)
        if not symmetric_eigen(G, m, values, V, small):
            return False
        for k in range(m):
            b = B[k]
            b[:] = 0.0
            innovation = 0.0
            for j in range(m):
                add_scaled(N, V[k, j], ZT[j], b)
                innovation += V[k, j] * d[j]
            grown = 1.0 + max(values[k], 0.0)
            add_scaled(N, innovation / grown, b, v)
            phi = 1.0 / (grown + np.sqrt(grown))
            for i in range(N):
                add_scaled(N, -phi * b[i], b, T[i])
        return True
    v[:], T[:] = 0.0, 0.0
    gram(ZT, m, N, G)
    if not symmetric_eigen(G, N, values, V, small):
        return False
    g = small[:N]
    g[:] = 0.0
    for k in range(m):
        add_scaled(N, d[k], ZT[k], g)
    for k in range(N):
        b = V[k]
        innovation = 0.0
        for i in range(N):
            innovation += b[i] * g[i]
        grown = 1.0 + max(values[k], 0.0)
        add_scaled(N, innovation / grown, b, v)
        root = 1.0 / np.sqrt(grown)
        for i in range(N):
            add_scaled(N, root * b[i], b, T[i])
    return True


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Condition the ensemble on a measurement; see the module's equations.

    Its moments become those of the Kalman update of the ensemble's own moments, exactly, where h is linear. The spread
    collapses over many measurements where members are few, unless it is inflated: the members' own sampling error is in
    no covariance.
    """
    # Z = (h(xᵢ) - ȳ) R^(-1/2) / √(N - 1),  d = R^(-1/2) (y - ȳ)
    X, a, rest, m, verdict = begin_analysis(context, u, sensor, y, state, work, innovation, innovation_std, score)
    if verdict != USED:
        return verdict
    index = next_draw(context, state)
    # T = (I + Z Zᵀ)^(-1/2),  w = (I + Z Zᵀ)⁻¹ Z d / √(N - 1)
    if not symmetric_transform(m, a):
        return FAILED
    transform_members(context, index, a, X, numbers(context)[INFLATION], rest)
    reconsider(context, index, X)
    finish(context, index, X, rest)
    return USED


ETKF = ensemble_filter(
    ROTATION,
    name="etkf",
    title="Ensemble transform Kalman filter",
    assumes="posterior near Gaussian, its spread within the span of the members; no localisation (letkf has it)",
    fails_when="few members of many states: chance covariances move states that the reading does not depend on",
    source="Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008",
    functions=(start, predict, update, describe),
    considers=True,
    work_size=work_size,
)
