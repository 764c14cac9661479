"""The ensemble transform Kalman filter: all members are turned at once so that their moments are the posterior's.

In whitened anomalies Z (N, m) of the expected reading and d of the reading itself (see innovation.py),

    x̄ ← x̄ + Aᵀ w,   w = (I + Z Zᵀ)⁻¹ Z d / √(N - 1);      A ← T A,   T = (I + Z Zᵀ)^(-1/2)

with the symmetric root, which changes the members least and leaves their mean. All of it happens in the space of
the members; the states follow in one product.

Sources: Bishop, Etherton & Majumdar (2001), doi:10.1175/1520-0493(2001)129<0420:ASWTET>2.0.CO;2; Hunt, Kostelich &
Szunyogh (2007), doi:10.1016/j.physd.2006.11.008; Sakov & Oke (2008), doi:10.1175/2007MWR2021.1 (symmetric root and
rotations that keep the mean).
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..estimator import Estimator
from ..numerics.jit import jit
from ..numerics.symmetric import gram, symmetric_eigen
from ..numerics.vectors import add_scaled
from ..track import FAILED, USED
from .analysis import begin_analysis, work_size
from .blocks import transform_all
from .forecast import add_spread, predict
from .innovation import judge_reading, observe
from .ranks import account
from .rotation import ROTATION, rotate_members
from .shared import (
    ADD,
    CREWS,
    INFLATE,
    INFLATION,
    MEMBERS,
    OWN,
    block,
    describe,
    ensemble,
    moments,
    next_draw,
    points,
    settle,
    start,
    state_size,
    tune,
)


@jit
def symmetric_transform(m, a):
    """T = (I + Z Zᵀ)^(-1/2) and v = √(N - 1) w, from the eigenvectors of Zᵀ Z or Z Zᵀ, whichever is smaller.

    With Zᵀ Z = V Λ Vᵀ,  T = I - Z V φ(Λ) Vᵀ Zᵀ,  φ(λ) = (1 - 1/√(1+λ))/λ = 1 / (1 + λ + √(1+λ)), which is good at 0.

    Args:
        m: Rows of the reading.
        a: The analysis, after `observe`; gets T and v.

    Returns:
        False if a number is not finite.
    """
    ZT, Z, d, G, V, values, small, v, B, T = a.ZT, a.Z, a.d, a.G, a.V, a.values, a.small, a.v, a.B, a.T
    N = ZT.shape[1]
    for i in range(N):
        v[i] = 0.0
        for j in range(N):
            T[i, j] = 0.0
    if m < N:
        gram(Z, N, m, G)
        if not symmetric_eigen(G, m, values, V, small):
            return False
        for i in range(N):
            T[i, i] = 1.0
        for k in range(m):
            b = B[k]
            for i in range(N):
                b[i] = 0.0
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
    gram(ZT, m, N, G)
    if not symmetric_eigen(G, N, values, V, small):
        return False
    g = small[:N]
    for i in range(N):
        g[i] = 0.0
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
def transform_members(context, index, m, a, X, rest):
    """x̄ + A ← x̄ + (T + 1 wᵀ) A for all states; False, and nothing is changed, if a number is not finite."""
    N = X.shape[0]
    T, W, v = a.T, a.W, a.v
    # T = (I + Z Zᵀ)^(-1/2),  w = (I + Z Zᵀ)⁻¹ Z d / √(N - 1)
    if not symmetric_transform(m, a):
        return False
    given = numbers(context)
    if given[OWN] > 0.0:
        rotate_members(context.seed, index, T, W)
    # W = T + 1 wᵀ, by which x̄ + W A are the members
    for i in range(N):
        for j in range(N):
            W[i, j] = given[INFLATION] * T[i, j] + v[j] / np.sqrt(N - 1.0)
        W[i, N] = 1.0
    transform_all(X, W, int(given[CREWS]), rest)
    return True


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Condition the ensemble on a reading; see the module's equations.

    Its moments become those of the Kalman update of the ensemble's own moments, exactly, where h is linear. The spread
    collapses over many readings where members are few, unless it is inflated: the members' own sampling error is in
    no covariance.
    """
    X = ensemble(context, state)
    a, rest = begin_analysis(context, sensor, X.shape[0], work)
    # Z = (h(xᵢ) - ȳ) R^(-1/2) / √(N - 1),  d = R^(-1/2) (y - ȳ)
    m = observe(context, sensor, u, y, state, a, innovation, innovation_std, score)
    verdict = judge_reading(context, sensor, m, a, score)
    if verdict != USED:
        return verdict
    index = next_draw(context, state)
    if not transform_members(context, index, m, a, X, rest):
        return FAILED
    add_spread(context, index, X, rest)
    settle(context, X)
    return USED


ETKF = Estimator(
    name="etkf",
    title="Ensemble transform Kalman filter",
    family="ensemble",
    assumes="posterior near Gaussian, its spread within the span of the members; no localisation (letkf has it)",
    model_runs="members",
    fails_when="few members of many states: chance covariances move what the reading knows nothing of",
    source="Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["members"],
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    blocks=block,
    account=account,
    points=points,
    options=(
        MEMBERS,
        INFLATE,
        ADD,
        ROTATION,
    ),
    tune=tune,
)
