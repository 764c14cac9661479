"""The local ensemble transform Kalman filter: the transform of the ETKF, anew for every state, from the rows near it.

At each state the variance of a row is divided by the taper of its distance, so that far rows count less, and rows
beyond the radius not at all. States are independent of each other, and are worked on by all threads.

Source: Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008, section 2.3 (steps 4 to 8), with the smooth
localisation of its section 2.3.3.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from .blocks import block_at, load, store
from .context import options as numbers
from .context import sensor_rows
from .ensemble import (
    ADD,
    CREWS,
    INFLATE,
    INFLATION,
    MEMBERS,
    RADIUS,
    add_spread,
    describe,
    ensemble,
    find_rows,
    judge,
    moments,
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
from .etkf import global_analysis
from .filter import Estimator
from .jit import ints, jit, matrix
from .localisation import localised, prepare, reached
from .simd import WIDE, add_scaled
from .symmetric import gram, symmetric_eigen
from .track import FAILED, USED


@jit
def local_transform(p, z, d, G, a, V, values, small, t):
    """Turn the anomalies a (N,) of one state by (I + Z Zᵀ)^(-1/2), of the p rows z near it; return what its mean gains.

    Only the transform's action on one vector is needed: with Zᵀ Z = V Λ Vᵀ and t = Vᵀ Zᵀ a,
    a ← a - Z V φ(Λ) t and x̄ gains tᵀ (I + Λ)⁻¹ Vᵀ d / √(N - 1); see `symmetric_transform` of etkf.py.

    Args:
        p: Rows near the state.
        z: Their whitened anomalies times √taper, (p, N).
        d: Their whitened innovation times √taper, (p,).
        G: Holds Zᵀ Z (p, p) if p < N; is destroyed.
        a: Anomalies of the state (N,).
        V: Scratch (side, side), side = min(p, N).
        values: Scratch (side,).
        small: Scratch (2 side,).
        t: Scratch (p + N,).

    Returns:
        What the mean gains; NaN if a number is not finite.
    """
    N = a.size
    gain = 0.0
    if p < N:
        if not symmetric_eigen(G, p, values, V, small):
            return np.nan
        for k in range(p):
            dot = 0.0
            for i in range(N):
                dot += z[k, i] * a[i]
            t[k] = dot
            small[k] = 0.0
        for k in range(p):
            along = 0.0
            innovation = 0.0
            for j in range(p):
                along += V[k, j] * t[j]
                innovation += V[k, j] * d[j]
            grown = 1.0 + max(values[k], 0.0)
            gain += along * innovation / grown
            add_scaled(p, along / (grown + np.sqrt(grown)), V[k].ctypes.data, small.ctypes.data)
        for k in range(p):
            add_scaled(N, -small[k], z[k].ctypes.data, a.ctypes.data)
        return gain / np.sqrt(N - 1.0)
    gram(z, p, N, G)
    if not symmetric_eigen(G, N, values, V, small):
        return np.nan
    g = small[:N]
    turned = t[:N]
    for i in range(N):
        g[i] = 0.0
        turned[i] = 0.0
    for k in range(p):
        add_scaled(N, d[k], z[k].ctypes.data, g.ctypes.data)
    for k in range(N):
        along = 0.0
        innovation = 0.0
        for i in range(N):
            along += V[k, i] * a[i]
            innovation += V[k, i] * g[i]
        grown = 1.0 + max(values[k], 0.0)
        gain += along * innovation / grown
        add_scaled(N, along / np.sqrt(grown), V[k].ctypes.data, turned.ctypes.data)
    for i in range(N):
        a[i] = turned[i]
    return gain / np.sqrt(N - 1.0)


@jit
def columns(context, sensor, X, where, ZT, d, C, inflation, crew, crews, scratch):
    """One crew's share of the states, each with its own transform."""
    N, n = X.shape
    ny = where.size
    blocks, starts, entry_rows, tapers = reached(context, sensor)
    # Scratch: a block; the rows near a state, their innovations, which they are, and the roots of their tapers; the
    # matrices and vectors of an eigenvalue problem; one state's anomalies.
    side = min(ny, N)
    at = (N + 2) * WIDE
    z = matrix(scratch, at, ny, N)
    at += ny * N
    G = matrix(scratch, at, side, side)
    V = matrix(scratch, at + side * side, side, side)
    at += 2 * side * side
    near_d = scratch[at : at + ny]
    near = ints(scratch.ctypes.data + 8 * (at + ny), ny)
    t = scratch[at + 2 * ny : at + 3 * ny + N]
    at += 3 * ny + N
    values = scratch[at : at + side]
    small = scratch[at + side : at + 3 * side]
    a = scratch[at + 3 * side : at + 3 * side + N]
    for e in range(crew * blocks.size // crews, (crew + 1) * blocks.size // crews):
        first, count, width = block_at(blocks[e], n)
        block = matrix(scratch, 0, N + 1, width)
        load(X, first, count, width, block)
        for j in range(count):
            p = 0
            most = 0.0
            for entry in range(starts[e], starts[e + 1]):
                k = where[entry_rows[entry]]
                taper = tapers[entry, j]
                if k >= 0 and taper > 0.0:
                    root = np.sqrt(taper)
                    near[p] = k
                    near_d[p] = root * d[k]
                    t[p] = root
                    for i in range(N):
                        z[p, i] = root * ZT[k, i]
                    most = max(most, taper)
                    p += 1
            if p == 0:
                continue
            if p < N:
                for k in range(p):
                    for i in range(p):
                        G[k, i] = t[k] * t[i] * C[near[k], near[i]]
            for i in range(N):
                a[i] = block[i, j]
            gain = local_transform(p, z, near_d, G, a, V, values, small, t)
            factor = 1.0 + (inflation - 1.0) * most
            for i in range(N):
                block[i, j] = factor * a[i]
            block[N, j] += gain
        store(X, first, count, block)


@jit(parallel=True)
def _columns_on_threads(context, sensor, X, where, ZT, d, C, inflation, crews, scratch, each):
    for crew in prange(crews):
        own = scratch[crew * each : (crew + 1) * each]
        columns(context, sensor, X, where, ZT, d, C, inflation, crew, crews, own)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Condition the ensemble on a reading; see the module's equations.

    Without localisation it is the ETKF. With a radius so short that neighbours see different rows, the analysis is
    rough in space.
    """
    X = ensemble(context, state)
    N = X.shape[0]
    _, ny = sensor_rows(context, sensor)
    local = localised(context)
    parts = workspace(N, ny, ny if local else min(ny, N), work)
    ZT, Z, B, G, U, V, W, T, d, rows, expected, v, where, values, small, rest = parts
    m = observe(context, sensor, u, y, X, ZT, d, rows, expected, innovation, innovation_std)
    verdict = judge(context, sensor, m, ZT, Z, d, rows, G, U, v, score)
    if verdict != USED:
        return verdict
    given = numbers(context)
    crews = int(given[CREWS])
    if local:
        find_rows(m, rows, where)
        gram(Z, N, m, U)
        if crews > 1:
            each = rest.size // crews
            _columns_on_threads(context, sensor, X, where, ZT, d, U, given[INFLATION], crews, rest, each)
        else:
            columns(context, sensor, X, where, ZT, d, U, given[INFLATION], 0, 1, rest)
    elif not global_analysis(context, index, m, ZT, Z, d, G, V, values, small, v, B, T, W, X, rest):
        return FAILED
    add_spread(context, index, X, rest)
    settle(context, X)
    return USED


LETKF = Estimator(
    name="letkf",
    title="Local ensemble transform Kalman filter",
    family="ensemble",
    assumes="posterior near Gaussian; what is far apart is independent, and the model says where states and sensors are",
    model_runs="members",
    fails_when="radius too long for the members (chance covariances) or too short for the physics",
    source="Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008",
    functions=(start, predict, update, describe),
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    points=points,
    options=(MEMBERS, INFLATE, ADD, RADIUS),
    tune=tune,
    prepare=prepare,
)
