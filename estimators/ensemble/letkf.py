"""The local ensemble transform Kalman filter: the transform of the ETKF, anew for every state, from the rows near it.

At each state the variance of a row is divided by the taper of its distance, so that far rows count less, and rows
beyond the radius not at all. States are independent of each other, and are worked on by all threads.

Source: Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008, with their smooth localisation: R⁻¹ times a
factor that falls with the distance. Their inflation is of the forecast; here, as in all ensemble filters, it is of the
analysis.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from ..compiled.context import context_at, place_of, sensor_rows
from ..compiled.context import options as numbers
from ..estimator import Estimator
from ..numerics.inverse_root import root_action
from ..numerics.jit import ints, jit, matrix
from ..numerics.simd import WIDE, add_scaled, combine, dot
from ..numerics.symmetric import gram
from ..track import FAILED, USED
from .blocks import block_at, load, store
from .etkf import global_analysis
from .localisation import localised, prepare, reached
from .rotation import ROTATION, rotate
from .shared import (
    ADD,
    CREWS,
    INFLATE,
    INFLATION,
    MEMBERS,
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
def local_transform(p, z, d, G, a, values, t, g, scratch):
    """Turn the anomalies a (N,) of one state by (I + Z Zᵀ)^(-1/2), of the p rows z near it; return what its mean gains.

    Only the transform's action on one vector is needed: with t = Zᵀ a,
    a ← a - Z φ(Zᵀ Z) t and x̄ gains tᵀ (I + Zᵀ Z)⁻¹ d / √(N - 1); φ as in `symmetric_transform` of etkf.py.

    Args:
        p: Rows near the state.
        z: Their whitened anomalies times √taper, (p, N).
        d: Their whitened innovation times √taper, (p,); is destroyed.
        G: Holds Zᵀ Z (p, p) if p < N; is destroyed.
        a: Anomalies of the state (N,).
        values: Scratch (side,), side = min(p, N).
        t: Scratch (side,).
        g: Scratch (side,).
        scratch: As `root_action` wants it.

    Returns:
        What the mean gains; NaN if a number is not finite.
    """
    N = a.size
    if p < N:
        for k in range(p):
            t[k] = dot(N, z[k].ctypes.data, a.ctypes.data)
        gain = root_action(G, p, values, t, d, False, scratch)
        for k in range(p):
            add_scaled(N, -t[k], z[k].ctypes.data, a.ctypes.data)
        return gain / np.sqrt(N - 1.0)
    gram(z, p, N, G)
    for i in range(N):
        g[i] = 0.0
    for k in range(p):
        add_scaled(N, d[k], z[k].ctypes.data, g.ctypes.data)
    return root_action(G, N, values, a, g, True, scratch) / np.sqrt(N - 1.0)


@jit
def columns(context, sensor, X, where, ZT, d, C, inflation, crew, crews, scratch):
    """One crew's share of the states, each with its own transform."""
    N, n = X.shape
    ny = where.size
    blocks, starts, entry_rows, tapers = reached(context, sensor)
    # Scratch: a block; the rows near a state, their innovations, which they are, and the roots of their tapers; a
    # matrix and vectors of `root_action`; one state's anomalies.
    side = min(ny, N)
    at = (N + 2) * WIDE
    z = matrix(scratch, at, ny, N)
    at += ny * N
    near_d = scratch[at : at + ny]
    near = ints(scratch.ctypes.data + 8 * (at + ny), ny)
    roots = scratch[at + 2 * ny : at + 3 * ny]
    at += 3 * ny
    values = scratch[at : at + side]
    t = scratch[at + side : at + 2 * side]
    g = scratch[at + 2 * side : at + 3 * side]
    a = scratch[at + 3 * side : at + 3 * side + N]
    at += 3 * side + N
    square = at
    rest = scratch[at + side * side :]
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
                    roots[p] = root
                    combine(1, roots[p:].ctypes.data, 1, ZT[k].ctypes.data, N, N, z[p].ctypes.data)
                    most = max(most, taper)
                    p += 1
            if p == 0:
                continue
            order = min(p, N)
            G = matrix(scratch, square, order, order)
            if p < N:
                for k in range(p):
                    for i in range(p):
                        G[k, i] = roots[k] * roots[i] * C[near[k], near[i]]
            for i in range(N):
                a[i] = block[i, j]
            gain = local_transform(p, z, near_d, G, a, values, t, g, rest)
            factor = 1.0 + (inflation - 1.0) * most
            for i in range(N):
                block[i, j] = factor * a[i]
            block[N, j] += gain
        store(X, first, count, block)


@jit(parallel=True)
def _columns_on_threads(context, sensor, X, where, ZT, d, C, inflation, crews, scratch, each):
    place = place_of(context)
    for crew in prange(crews):
        own = scratch[crew * each : (crew + 1) * each]
        columns(context_at(place), sensor, X, where, ZT, d, C, inflation, crew, crews, own)


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
    index = next_draw(X, state)
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
        rotate(context, index, X, T, W, rest)
    elif not global_analysis(context, index, m, ZT, Z, d, G, V, values, small, v, B, T, W, X, rest):
        return FAILED
    add_spread(context, index, X, rest)
    settle(context, X)
    return USED


LETKF = Estimator(
    name="letkf",
    title="Local ensemble transform Kalman filter",
    family="ensemble",
    assumes="posterior near Gaussian; what is far apart is independent; the model says where states and sensors are",
    model_runs="members",
    fails_when="radius too long for the members (chance covariances) or too short for the physics",
    source="Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["members"],
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    blocks=block,
    points=points,
    options=(MEMBERS, INFLATE, ADD, RADIUS, ROTATION),
    tune=tune,
    prepare=prepare,
)
