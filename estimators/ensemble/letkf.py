"""The local ensemble transform Kalman filter: the transform of the ETKF, anew for every state, from the rows near it.

At each state the variance of a row is divided by the taper of its distance, so that far rows count less, and rows
beyond the radius not at all. States are independent of each other; all threads share them.

Source: Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008, with their smooth localisation: R⁻¹ times a
factor that falls with the distance. Their inflation is of the forecast; here, as in all ensemble filters, it is of the
analysis.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from ..compiled.context import context_at, place_of
from ..compiled.context import options as numbers
from ..numerics.inverse_root import root_action, scratch_of
from ..numerics.jit import jit, matrix
from ..numerics.simd import WIDE, add_scaled, dot, scaled
from ..numerics.symmetric import gram
from ..numerics.workspace import declare_layout, share, size_of, start_of
from ..track import FAILED, USED
from .analysis import begin_analysis, find_places, reconsider, work_size
from .blocks import ROTATION, block_at, load, rotate, store, transform_members
from .etkf import symmetric_transform
from .localisation import localised, prepare, reached
from .shared import (
    CREWS,
    INFLATION,
    RADIUS,
    describe,
    ensemble_filter,
    finish,
    members,
    next_draw,
    predict,
    start,
)

Local, local_at = declare_layout(
    "Local",
    "N, ny, side",
    scratch_of,
    block=f"(N + 1) * {WIDE}",
    z="ny, N",
    d="ny",
    near="int ny",
    roots="ny",
    values="side",
    t="side",
    g="side",
    a="N",
    G="side * side",
    actions="scratch_of(side)",
)
"""Scratch of a crew: a block; anomalies z and innovations d of the rows near a state, times the root of the taper,
their indices and these roots; vectors for `root_action` of length `side`, the smaller of N and ny; one state's
anomalies a, a Gram matrix, and the scratch of `root_action`."""


@jit
def local_transform(p, z, d, G, a, values, t, g, scratch):
    """Transform the anomalies a (N,) of one state by (I + Z Zᵀ)^(-1/2), from the p rows z near it.

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
        scratch: For `root_action`.

    Returns:
        The gain of the mean; NaN if a number is not finite.
    """
    N = a.size
    if p < N:
        for k in range(p):
            t[k] = dot(N, z[k], a)
        gain = root_action(G, p, values, t, d, False, scratch)
        for k in range(p):
            add_scaled(N, -t[k], z[k], a)
        return gain / np.sqrt(N - 1.0)
    gram(z, p, N, G)
    for i in range(N):
        g[i] = 0.0
    for k in range(p):
        add_scaled(N, d[k], z[k], g)
    return root_action(G, N, values, a, g, True, scratch) / np.sqrt(N - 1.0)


@jit
def transform_columns(context, sensor, X, places, ZT, d, C, inflation, crew, crews, scratch):
    """Transform one crew's share of the states, each from the rows near it."""
    N, n = X.shape
    ny = places.size
    blocks, starts, entry_rows, tapers = reached(context, sensor)
    room = local_at(start_of(scratch), N, ny, min(ny, N))
    z, d_near, near, roots, values, t, g, a = room.z, room.d, room.near, room.roots, room.values, room.t, room.g, room.a
    for e in range(crew * blocks.size // crews, (crew + 1) * blocks.size // crews):
        first, count, width = block_at(blocks[e], n)
        block = matrix(room.block, 0, N + 1, width)
        load(X, first, count, width, block)
        for j in range(count):
            p = 0
            most = 0.0
            for entry in range(starts[e], starts[e + 1]):
                k = places[entry_rows[entry]]
                taper = tapers[entry, j]
                if k >= 0 and taper > 0.0:
                    root = np.sqrt(taper)
                    near[p] = k
                    d_near[p] = root * d[k]
                    roots[p] = root
                    scaled(N, root, ZT[k], z[p])
                    most = max(most, taper)
                    p += 1
            if p == 0:
                continue
            order = min(p, N)
            G = matrix(room.G, 0, order, order)
            if p < N:
                for k in range(p):
                    for i in range(p):
                        G[k, i] = roots[k] * roots[i] * C[near[k], near[i]]
            for i in range(N):
                a[i] = block[i, j]
            gain = local_transform(p, z, d_near, G, a, values, t, g, room.actions)
            factor = 1.0 + (inflation - 1.0) * most
            for i in range(N):
                block[i, j] = factor * a[i]
            block[N, j] += gain
        store(X, first, count, block)


@jit(parallel=True)
def _columns_on_threads(context, sensor, X, places, ZT, d, C, inflation, crews, scratch):
    place = place_of(context)
    for crew in prange(crews):
        own = share(scratch, crew, crews)
        transform_columns(context_at(place), sensor, X, places, ZT, d, C, inflation, crew, crews, own)


@jit
def transform_locally(context, sensor, X, a, inflation, crews, scratch):
    """Transform every state that the sensor reaches from the rows near it; a.U holds Zᵀ Z."""
    if crews > 1:
        _columns_on_threads(context, sensor, X, a.places, a.ZT, a.d, a.U, inflation, crews, scratch)
    else:
        transform_columns(context, sensor, X, a.places, a.ZT, a.d, a.U, inflation, 0, 1, scratch)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Condition the ensemble on a measurement; see the module's equations.

    Without localisation it is the ETKF. If the radius is so short that neighbours see different rows, the analysis is
    rough in space.
    """
    X, a, rest, m, verdict = begin_analysis(context, u, sensor, y, state, work, innovation, innovation_std, score)
    if verdict != USED:
        return verdict
    index = next_draw(context, state)
    given = numbers(context)
    if localised(context):
        # Of each state: a ← (I + Z ρ Zᵀ)^(-1/2) a and x̄ ← x̄ + aᵀ (I + Z ρ Zᵀ)⁻¹ Z ρ d / √(N - 1).
        find_places(m, a.rows, a.places)
        gram(a.Z, X.shape[0], m, a.U)
        transform_locally(context, sensor, X, a, given[INFLATION], int(given[CREWS]), rest)
        rotate(context, index, X, a, rest)
    elif symmetric_transform(m, a):
        transform_members(context, index, a, X, rest)
    else:
        return FAILED
    reconsider(context, index, X)
    finish(context, index, X, rest)
    return USED


LETKF = ensemble_filter(
    RADIUS,
    ROTATION,
    name="letkf",
    title="Local ensemble transform Kalman filter",
    assumes="posterior near Gaussian; distant states are independent; the model gives positions of states and sensors",
    fails_when="radius too long for the members (chance covariances) or too short for the physics",
    source="Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008",
    functions=(start, predict, update, describe),
    considers=True,
    work_size=lambda options, nx, ny: work_size(
        options, nx, ny, size_of(local_at, members(options), ny, min(ny, members(options)))
    ),
    prepare=prepare,
)
