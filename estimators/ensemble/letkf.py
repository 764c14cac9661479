"""The local ensemble transform Kalman filter: the transform of the ETKF, anew for every state, from the rows near it.

At each state the variance of a row is divided by the taper of its distance, so that far rows count less, and rows
beyond the radius not at all. On a circle the distance is the short way round. States are independent of each other; all
threads share them. With a variance for each state there is no one S: NIS, gate and likelihood are those of the forecast
covariance between the rows, tapered by their distance, as in `enkf` (analysis.py). They judge the forecast, not the
weight that the analysis gives to a measurement.

Source: Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008, with their smooth localisation: R⁻¹ times a
factor that falls with the distance. Their inflation is of the forecast; here, as in all ensemble filters, it is of the
analysis.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from ..compiled.context import context_at, place_of
from ..compiled.context import options as numbers
from ..numerics.inverse_root import action_at, root_action
from ..numerics.jit import jit, matrix
from ..numerics.simd import WIDE, add_scaled, square_roots
from ..numerics.simd_ir import LANES
from ..numerics.simd_lanes import scale_rows, weighted_gram
from ..numerics.simd_rows import multiply_rows, subtract_product
from ..numerics.symmetric import gram
from ..numerics.workspace import declare_layout, line_from, share, size_of, start_of
from ..track import FAILED, USED
from .analysis import begin_analysis, find_places, reconsider, work_size
from .blocks import ROTATION, block_at, load, rotate, store, transform_members
from .etkf import symmetric_transform
from .localisation import localised, prepare, reached
from .shared import CREWS, INFLATION, RADIUS, describe, ensemble_filter, finish, members, next_draw, predict, start

Local, local_at = declare_layout(
    "Local",
    "N, ny, side",
    action_at,
    block=f"(N + 1) * {WIDE}",
    moved=f"(N + 1) * {WIDE}",
    t=f"ny * {WIDE}",
    x=f"ny * {WIDE}",
    roots=f"ny, {WIDE}",
    own_roots=f"ny, {LANES}",
    G=f"side * side, {LANES}",
    b=f"side, {LANES}",
    g=f"side, {LANES}",
    gain=f"{LANES}",
    action="Action(at, side)",
    z="ny * N",
    across="ny * N",
    near="int ny",
    own="int ny",
)
"""Scratch of a crew: a block before and after; t = Z a of the rows near it, and their factors x in the correction; the
root of their tapers, and of those near a group of `LANES` states; matrices and vectors of a group, of order `side`, the
smaller of N and ny; the anomalies z (rows, N) of the rows near the block, and their transpose; indices of the rows near
the block, and among these of those near the group."""


@jit
def near_block(e, starts, entry_rows, tapers, places, near, roots):
    """Find the finite rows near a block and the roots of their tapers; return how many there are."""
    count = 0
    for entry in range(starts[e], starts[e + 1]):
        k = places[entry_rows[entry]]
        if k >= 0:
            near[count] = k
            square_roots(WIDE, tapers[entry], roots[count])
            count += 1
    return count


@jit
def near_group(count, at, roots, own, own_roots):
    """Find among the rows near a block those near its `LANES` states from `at` on; return how many there are."""
    p = 0
    for q in range(count):
        reaches = False
        for lane in range(LANES):
            root = roots[q, at + lane]
            own_roots[p, lane] = root
            reaches = reaches or root > 0.0
        if reaches:
            own[p] = q
            p += 1
    return p


@jit
def transform_group(at, p, room, z, t, x, block, d, C):
    """Find the transform of `LANES` states of a block, from `at` on, from the p rows near them.

    Of each state with the anomalies a (N,) only the transform's action on one vector is needed: with t = Z a,
    a ← a - Zᵀ φ(Z Zᵀ) t and x̄ gains tᵀ (I + Z Zᵀ)⁻¹ d / √(N - 1), Z (p, N) times √taper; φ as in `symmetric_transform`
    of etkf.py. With N rows or more, a ← (I + Zᵀ Z)^(-1/2) a is smaller.

    On return x holds √taper φ(Z Zᵀ) t by rows, or the block its new anomalies; and the mean has its gain.
    """
    N = block.shape[0] - 1
    own, roots, G, b, g, gain = room.own, room.own_roots, room.G, room.b, room.g, room.gain
    if p < N:
        scale_rows(p, own, room.near, roots, C, d, t, at, G, b, g)
        root_action(G, p, b, g, False, room.action, gain)
        for k in range(p):
            for lane in range(LANES):
                x[own[k], at + lane] = roots[k, lane] * b[k, lane]
    else:
        for i in range(N):
            for lane in range(LANES):
                g[i, lane] = 0.0
                b[i, lane] = block[i, at + lane]
        for k in range(p):
            innovation = d[room.near[own[k]]]
            for lane in range(LANES):
                roots[k, lane] *= roots[k, lane]
            for i in range(N):
                add_scaled(LANES, z[own[k], i] * innovation, roots[k], g[i])
        weighted_gram(p, own, roots, z, N, G)
        root_action(G, N, b, g, True, room.action, gain)
        for i in range(N):
            for lane in range(LANES):
                block[i, at + lane] = b[i, lane]
    add_scaled(LANES, 1.0 / np.sqrt(N - 1.0), gain, block[N, at:])


@jit
def transform_columns(context, sensor, X, places, ZT, d, C, inflation, crew, crews, scratch):
    """Transform one crew's share of the states, each from the rows near it."""
    N, n = X.shape
    ny = places.size
    blocks, starts, entry_rows, tapers = reached(context, sensor)
    room = local_at(line_from(start_of(scratch)), N, ny, min(ny, N))
    near = room.near
    for e in range(crew * blocks.size // crews, (crew + 1) * blocks.size // crews):
        first, count, width = block_at(blocks[e], n)
        block, moved = matrix(room.block, 0, N + 1, width), matrix(room.moved, 0, N + 1, width)
        rows = near_block(e, starts, entry_rows, tapers, places, near, room.roots)
        if rows == 0:
            continue
        load(X, first, count, width, block)
        z, across = matrix(room.z, 0, rows, N), matrix(room.across, 0, N, rows)
        t, x = matrix(room.t, 0, rows, width), matrix(room.x, 0, rows, width)
        x[:] = 0.0
        for k in range(rows):
            for i in range(N):
                z[k, i] = ZT[near[k], i]
                across[i, k] = z[k, i]
        multiply_rows(z, rows, N, block, 0, t)
        for at in range(0, width, LANES):
            p = near_group(rows, at, room.roots, room.own, room.own_roots)
            if p > 0:
                transform_group(at, p, room, z, t, x, block, d, C)
        subtract_product(block, across, N, rows, x, 0, moved)
        for j in range(width):
            moved[N, j] = block[N, j]
        if inflation != 1.0:
            for j in range(width):
                most = 0.0
                for entry in range(starts[e], starts[e + 1]):
                    if places[entry_rows[entry]] >= 0:
                        most = max(most, tapers[entry, j])
                factor = 1.0 + (inflation - 1.0) * most
                for i in range(N):
                    moved[i, j] *= factor
        store(X, first, count, moved)


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
        transform_members(context, index, a, X, given[INFLATION], rest)
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
    prepare=lambda model, options: prepare(model, options, shortest=True),
)
