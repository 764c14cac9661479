"""The ensemble block by block: 32 states of all members at a time, which the processor's cache holds.

A block is the anomalies of its states (N rows) and their mean (row N). An analysis reads each number of the ensemble
once and writes it once, in place; its cost is that of the memory, and its scratch a few kilobytes a thread.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from ..compiled.context import context_at, place_of
from ..compiled.context import options as numbers
from ..estimator import Option
from ..numerics.jit import jit, matrix
from ..numerics.linalg import copy
from ..numerics.random import key_of, normal
from ..numerics.simd import WIDE, add_scaled, added, combine_rows, copied, spread_rows
from ..numerics.simd_ir import LANES
from ..numerics.workspace import declare_layout, line_from, share, start_of
from .localisation import localised, reached
from .shared import CREWS, OWN, ROTATE


@jit
def blocks_of(n):
    """Return the number of blocks of n states: of `WIDE` columns, and of `LANES` behind them."""
    return n // WIDE + (n % WIDE + LANES - 1) // LANES


@jit
def block_at(b, n):
    """Return the first state of a block, its number of states, and its columns (the rest of them is zero)."""
    wide = n // WIDE
    if b < wide:
        return b * WIDE, WIDE, WIDE
    first = wide * WIDE + (b - wide) * LANES
    return first, min(LANES, n - first), LANES


Transform, transform_at = declare_layout("Transform", "N, width", block="N + 1, width", out="width")
"""Scratch of a crew that transforms a block: the block, and a row of the result."""


Regression, regression_at = declare_layout(
    "Regression", "N, width", block="N + 1, width", seen="N, width", c="width", reach="width"
)
"""Scratch of a crew that regresses a block: the block, the forecast's anomalies, a row's c, its reach."""


@jit
def load(X, first, count, width, block):
    """Copy a block out of the ensemble: anomalies in rows 0 to N - 1, the mean in row N."""
    N = X.shape[0]
    mean = block[N]
    mean[:] = 0.0
    for i in range(N):
        row = block[i]
        copied(count, X[i, first:], row)
        row[count:] = 0.0
        # About the first member, so that a spread far below the size of the numbers keeps its digits.
        if i > 0:
            add_scaled(width, -1.0, block[0], row)
            add_scaled(width, 1.0 / N, row, mean)
    for i in range(1, N):
        add_scaled(width, -1.0, mean, block[i])
    for j in range(width):
        shift = mean[j]
        mean[j] += block[0, j]
        block[0, j] = -shift


@jit
def store(X, first, count, block):
    """Copy a block back."""
    N = X.shape[0]
    for i in range(N):
        added(count, block[N], block[i], X[i, first:])


@jit
def transform(X, W, crew, crews, scratch):
    """Apply one crew's share of X ← x̄ + W A, with W (N, N + 1): its last column, of ones, takes the mean along."""
    N, n = X.shape
    blocks = blocks_of(n)
    for b in range(crew * blocks // crews, (crew + 1) * blocks // crews):
        first, count, width = block_at(b, n)
        block, out, _ = transform_at(line_from(start_of(scratch)), N, width)
        load(X, first, count, width, block)
        for i in range(N):
            if count == width:
                combine_rows(W[i], N + 1, block, X[i, first:])
            else:
                combine_rows(W[i], N + 1, block, out)
                for j in range(count):
                    X[i, first + j] = out[j]


@jit(parallel=True)
def _transform_on_threads(X, W, crews, scratch):
    for crew in prange(crews):
        transform(X, W, crew, crews, share(scratch, crew, crews))


@jit
def transform_all(X, W, crews, scratch):
    """X ← x̄ + W A for all states."""
    if crews > 1:
        _transform_on_threads(X, W, crews, scratch)
    else:
        transform(X, W, 0, 1, scratch)


@jit
def regress(context, sensor, X, places, ZT, B, serial, inflation, crew, crews, scratch):
    """Regress one crew's share of the states on the rows of a measurement, tapered state by state.

    For each row k that reaches a state: c = ρ Σᵢ aᵢ ZT[k, i], then aᵢ += B[k, i] c and the mean += B[k, N] c. In a
    serial regression a row sees the anomalies that the rows before it left, otherwise all see the forecast.

    Args:
        context: The context.
        sensor: Its index.
        X: Members (N, n).
        places: For each row of the measurement its index k, or -1 where it is missing.
        ZT: Whitened anomalies (m, N).
        B: Factors of a regression coefficient on members and mean, (m, N + 1).
        serial: Whether rows are assimilated one after the other.
        inflation: Factor on the anomalies, where the taper is 1; 1 where it is 0.
        crew: Index of the share.
        crews: Number of shares.
        scratch: The crew's own.
    """
    N, n = X.shape
    local = localised(context)
    if local:
        blocks, starts, entry_rows, tapers = reached(context, sensor)
        how_many = blocks.size
    else:
        # Every block, all rows, no taper; the arrays are not looked at.
        blocks, starts, entry_rows, tapers = places, places, places, matrix(scratch, 0, 0, WIDE)
        how_many = blocks_of(n)
    for e in range(crew * how_many // crews, (crew + 1) * how_many // crews):
        first, count, width = block_at(blocks[e] if local else e, n)
        block, forecast, c, reach, _ = regression_at(line_from(start_of(scratch)), N, width)
        load(X, first, count, width, block)
        seen = block
        if not serial:
            seen = forecast
            copy(block[:N], seen)
        reach[:] = 0.0 if local else 1.0
        begin, end = (starts[e], starts[e + 1]) if local else (0, places.size)
        for entry in range(begin, end):
            k = places[entry_rows[entry] if local else entry]
            if k < 0:
                continue
            combine_rows(ZT[k], N, seen, c)
            if local:
                for j in range(width):
                    c[j] *= tapers[entry, j]
                    reach[j] = max(reach[j], tapers[entry, j])
            spread_rows(B[k], N + 1, c, block)
        if inflation != 1.0:
            for j in range(width):
                reach[j] = 1.0 + (inflation - 1.0) * reach[j]
            for i in range(N):
                for j in range(width):
                    block[i, j] *= reach[j]
        store(X, first, count, block)


@jit(parallel=True)
def _regress_on_threads(context, sensor, X, places, ZT, B, serial, inflation, crews, scratch):
    place = place_of(context)
    for crew in prange(crews):
        own = share(scratch, crew, crews)
        regress(context_at(place), sensor, X, places, ZT, B, serial, inflation, crew, crews, own)


@jit
def regress_all(context, sensor, X, places, ZT, B, serial, inflation, crews, scratch):
    """Apply `regress` to all states."""
    if crews > 1:
        _regress_on_threads(context, sensor, X, places, ZT, B, serial, inflation, crews, scratch)
    else:
        regress(context, sensor, X, places, ZT, B, serial, inflation, 0, 1, scratch)


ROTATION = Option("rotation", 0, 0, 1, "", "1 turns the members at random after each reading; mean and spread stay")


@jit
def rotate_members(seed, index, T, W):
    """T ← Ω T with a random orthogonal Ω that keeps the mean: Ω 1 = Ωᵀ 1 = 1; W is scratch (N, N + 1).

    Ω = H diag(1, Q) H, where the reflection H turns the first unit vector into 1/√N and Q is a random rotation of the
    other N - 1 axes, from the orthogonalisation of normal numbers.

    Source: Sakov & Oke (2008), doi:10.1175/2007MWR2021.1.
    """
    N = T.shape[0]
    key = key_of(seed, index, ROTATE)
    Q = np.zeros((N, N))
    Q[0, 0] = 1.0
    for i in range(1, N):
        for j in range(1, N):
            Q[i, j] = normal(key, np.uint64(i * N + j))
        # Twice: the second time takes away what rounding left.
        for _ in range(2):
            for k in range(1, i):
                dot = 0.0
                for j in range(1, N):
                    dot += Q[i, j] * Q[k, j]
                add_scaled(N, -dot, Q[k], Q[i])
        norm = 0.0
        for j in range(1, N):
            norm += Q[i, j] * Q[i, j]
        for j in range(1, N):
            Q[i, j] /= np.sqrt(norm)
    h = np.full(N, 1.0 / np.sqrt(N))
    h[0] -= 1.0
    half = 1.0 - 1.0 / np.sqrt(N)
    for _ in range(2):
        for i in range(N):
            dot = 0.0
            for j in range(N):
                dot += Q[i, j] * h[j]
            add_scaled(N, -dot / half, h, Q[i])
        for i in range(N):
            for j in range(i):
                Q[i, j], Q[j, i] = Q[j, i], Q[i, j]
    W[:] = 0.0
    for i in range(N):
        for k in range(N):
            add_scaled(N, Q[i, k], T[k], W[i])
    copy(W[:, :N], T)


@jit
def transform_members(context, index, a, X, inflation, rest):
    """x̄ + A ← x̄ + (T + 1 wᵀ) A for all states, with T (N, N) and v = √(N - 1) w of the analysis; rotate and inflate."""
    N = X.shape[0]
    T, W, v = a.T, a.W, a.v
    given = numbers(context)
    if given[OWN] > 0.0:
        rotate_members(context.seed, index, T, W)
    # W = T + 1 wᵀ, by which x̄ + W A are the members
    for i in range(N):
        for j in range(N):
            W[i, j] = inflation * T[i, j] + v[j] / np.sqrt(N - 1.0)
        W[i, N] = 1.0
    transform_all(X, W, int(given[CREWS]), rest)


@jit
def rotate(context, index, X, a, rest):
    """Rotate the members X (N, n), where the option is set; T, v and W of the analysis are scratch."""
    if numbers(context)[OWN] > 0.0:
        identity(a.T, a.v)
        transform_members(context, index, a, X, 1.0, rest)


@jit
def identity(T, v):
    """Set the transform T to the identity, and v to zero."""
    T[:], v[:] = 0.0, 0.0
    for i in range(T.shape[0]):
        T[i, i] = 1.0
