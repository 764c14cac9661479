"""The transform of the LETKF: of each state by itself, from the rows near it.

Source: Hunt, Kostelich & Szunyogh (2007), doi:10.1016/j.physd.2006.11.008.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from ..compiled.context import context_at, place_of
from ..numerics.inverse_root import root_action, scratch_of
from ..numerics.jit import jit, matrix
from ..numerics.simd import WIDE
from ..numerics.symmetric import gram
from ..numerics.vectors import add_scaled, dot, scaled
from ..numerics.workspace import layout, share, start_of, take_integers, take_matrix, take_vector
from .blocks import block_at, load, store
from .localisation import reached


class Local(NamedTuple):
    """What a crew turns states in.

    A block of (N + 1) WIDE numbers; of the rows near a state their anomalies z (ny, N) and innovations d (ny,) times
    the root of the taper, which they are (ny,) and these roots (ny,); vectors for `root_action` (side,) each; one
    state's anomalies a (N,), a Gram matrix of side² numbers, and the scratch of `root_action`.
    """

    block: Any
    z: Any
    d: Any
    near: Any
    roots: Any
    values: Any
    t: Any
    g: Any
    a: Any
    G: Any
    actions: Any
    end: int


@layout
def local_at(at, N, ny, side):
    """Lay it out; `side` is the smaller of N and ny."""
    block, at = take_vector(at, (N + 1) * WIDE)
    z, at = take_matrix(at, ny, N)
    d, at = take_vector(at, ny)
    near, at = take_integers(at, ny)
    roots, at = take_vector(at, ny)
    values, at = take_vector(at, side)
    t, at = take_vector(at, side)
    g, at = take_vector(at, side)
    a, at = take_vector(at, N)
    G, at = take_vector(at, side * side)
    actions, at = take_vector(at, scratch_of(side))
    return Local(block, z, d, near, roots, values, t, g, a, G, actions, at)


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
    """One crew's share of the states, each with its own transform."""
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
                    scaled(N, roots[p:], ZT[k], z[p])
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
    """Give every state that the sensor reaches the transform of the rows near it; a.U holds Zᵀ Z."""
    if crews > 1:
        _columns_on_threads(context, sensor, X, a.places, a.ZT, a.d, a.U, inflation, crews, scratch)
    else:
        transform_columns(context, sensor, X, a.places, a.ZT, a.d, a.U, inflation, 0, 1, scratch)
