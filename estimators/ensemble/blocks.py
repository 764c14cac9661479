"""The ensemble block by block: 32 states of all members at a time, which the processor's cache holds.

A block is the anomalies of its states (N rows) and their mean (row N). An analysis reads each number of the ensemble
once and writes it once, in place; its cost is that of the memory, and its scratch a few kilobytes a thread.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import prange

from ..compiled.context import context_at, place_of
from ..numerics.jit import jit, matrix
from ..numerics.simd import WIDE
from ..numerics.simd_ir import LANES
from ..numerics.vectors import add_scaled, combine_rows, spread_rows
from ..numerics.workspace import layout, share, start_of, take_matrix, take_vector
from .localisation import localised, reached


@jit
def blocks_of(n):
    """Blocks that n states make: of `WIDE` columns, and of `LANES` behind them."""
    return n // WIDE + (n % WIDE + LANES - 1) // LANES


@jit
def block_at(b, n):
    """First state of a block, how many it has, and the columns that it takes (the rest of them is zero)."""
    wide = n // WIDE
    if b < wide:
        return b * WIDE, WIDE, WIDE
    first = wide * WIDE + (b - wide) * LANES
    return first, min(LANES, n - first), LANES


class Transform(NamedTuple):
    """What a crew transforms a block in: the block (N + 1, width), and a row of the result (width,)."""

    block: Any
    out: Any
    end: int


@layout
def transform_at(at, N, width):
    """Lay it out."""
    block, at = take_matrix(at, N + 1, width)
    out, at = take_vector(at, width)
    return Transform(block, out, at)


class Regression(NamedTuple):
    """What a crew regresses a block in: the block (N + 1, width), the forecast's anomalies, a row's c, its reach."""

    block: Any
    seen: Any
    c: Any
    reach: Any
    end: int


@layout
def regression_at(at, N, width):
    """Lay it out."""
    block, at = take_matrix(at, N + 1, width)
    seen, at = take_matrix(at, N, width)
    c, at = take_vector(at, width)
    reach, at = take_vector(at, width)
    return Regression(block, seen, c, reach, at)


@jit
def load(X, first, count, width, block):
    """Take a block out of the ensemble: anomalies in rows 0 to N - 1, the mean in row N."""
    N = X.shape[0]
    mean = block[N]
    for j in range(width):
        mean[j] = 0.0
    for i in range(N):
        row = block[i]
        for j in range(count):
            row[j] = X[i, first + j]
        for j in range(count, width):
            row[j] = 0.0
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
    """Put a block back."""
    N = X.shape[0]
    for i in range(N):
        for j in range(count):
            X[i, first + j] = block[N, j] + block[i, j]


@jit
def transform(X, W, crew, crews, scratch):
    """One crew's share of X ← x̄ + W A, with W (N, N + 1): its last column, of ones, takes the mean along."""
    N, n = X.shape
    blocks = blocks_of(n)
    for b in range(crew * blocks // crews, (crew + 1) * blocks // crews):
        first, count, width = block_at(b, n)
        block, out, _ = transform_at(start_of(scratch), N, width)
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
    """One crew's share of a regression on the rows of a reading, tapered state by state.

    For each row k that reaches a state: c = ρ Σᵢ aᵢ ZT[k, i], then aᵢ += B[k, i] c and the mean += B[k, N] c. In a
    serial one a row sees what the rows before it left of the anomalies, else all see the forecast.

    Args:
        context: The context.
        sensor: Its index.
        X: Members (N, n).
        places: For each row of the reading its index k, or -1 where it is missing.
        ZT: Whitened anomalies (m, N).
        B: What a regression coefficient does to members and mean, (m, N + 1).
        serial: Whether rows are assimilated one after the other.
        inflation: Factor on the anomalies, where the taper is 1; 1 where it is 0.
        crew: Which share.
        crews: Of how many.
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
        block, forecast, c, reach, _ = regression_at(start_of(scratch), N, width)
        load(X, first, count, width, block)
        seen = block
        if not serial:
            seen = forecast
            for i in range(N):
                for j in range(width):
                    seen[i, j] = block[i, j]
        for j in range(width):
            reach[j] = 0.0 if local else 1.0
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
    """The regression of `regress` for all states."""
    if crews > 1:
        _regress_on_threads(context, sensor, X, places, ZT, B, serial, inflation, crews, scratch)
    else:
        regress(context, sensor, X, places, ZT, B, serial, inflation, 0, 1, scratch)
