"""The ensemble block by block: 32 states of all members at a time, which the processor's cache holds.

A block is the anomalies of its states (N rows) and their mean (row N). An analysis reads each number of the ensemble
once and writes it once, in place; its cost is that of the memory, and its scratch a few kilobytes a thread.
"""

from __future__ import annotations

from numba import prange

from ..compiled.context import context_at, place_of
from ..numerics.jit import jit, matrix
from ..numerics.simd import WIDE, add_scaled, combine_narrow, combine_wide, spread_narrow, spread_wide
from ..numerics.simd_ir import LANES
from .localisation import localised, reached


@jit
def block_count(n):
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


@jit
def combine(width, weights, count, x, out):
    """out = Σ_k weights[k] x[k] over the rows of a block (addresses)."""
    if width == WIDE:
        combine_wide(weights, count, x, WIDE, out)
    else:
        combine_narrow(weights, count, x, LANES, out)


@jit
def spread(width, weights, count, x, out):
    """out[k] += weights[k] x over the rows of a block (addresses)."""
    if width == WIDE:
        spread_wide(weights, count, x, out, WIDE)
    else:
        spread_narrow(weights, count, x, out, LANES)


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
            add_scaled(width, -1.0, block[0].ctypes.data, row.ctypes.data)
            add_scaled(width, 1.0 / N, row.ctypes.data, mean.ctypes.data)
    for i in range(1, N):
        add_scaled(width, -1.0, mean.ctypes.data, block[i].ctypes.data)
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
    blocks = block_count(n)
    out = scratch[(N + 1) * WIDE :]
    for b in range(crew * blocks // crews, (crew + 1) * blocks // crews):
        first, count, width = block_at(b, n)
        block = matrix(scratch, 0, N + 1, width)
        load(X, first, count, width, block)
        for i in range(N):
            if count == width:
                combine(width, W[i].ctypes.data, N + 1, block.ctypes.data, X[i, first:].ctypes.data)
            else:
                combine(width, W[i].ctypes.data, N + 1, block.ctypes.data, out.ctypes.data)
                for j in range(count):
                    X[i, first + j] = out[j]


@jit(parallel=True)
def _transform_on_threads(X, W, crews, scratch, each):
    for crew in prange(crews):
        transform(X, W, crew, crews, scratch[crew * each : (crew + 1) * each])


@jit
def transform_all(X, W, crews, scratch):
    """X ← x̄ + W A for all states."""
    if crews > 1:
        _transform_on_threads(X, W, crews, scratch, scratch.size // crews)
    else:
        transform(X, W, 0, 1, scratch)


@jit
def sweep(context, sensor, X, where, ZT, B, serial, inflation, crew, crews, scratch):
    """One crew's share of a regression on the rows of a reading, tapered state by state.

    For each row k that reaches a state: c = ρ Σᵢ aᵢ ZT[k, i], then aᵢ += B[k, i] c and the mean += B[k, N] c. In a
    serial sweep a row sees what the rows before it left of the anomalies, else all see the forecast.

    Args:
        context: The context.
        sensor: Its index.
        X: Members (N, n).
        where: For each row of the reading its index k, or -1 where it is missing.
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
        count_blocks = blocks.size
    else:
        # Every block, all rows, no taper; the arrays are not looked at.
        blocks, starts, entry_rows, tapers = where, where, where, matrix(scratch, 0, 0, WIDE)
        count_blocks = block_count(n)
    c = scratch[2 * (N + 1) * WIDE :]
    reach = c[WIDE:]
    for e in range(crew * count_blocks // crews, (crew + 1) * count_blocks // crews):
        first, count, width = block_at(blocks[e] if local else e, n)
        block = matrix(scratch, 0, N + 1, width)
        seen = block
        load(X, first, count, width, block)
        if not serial:
            seen = matrix(scratch, (N + 1) * WIDE, N, width)
            for i in range(N):
                for j in range(width):
                    seen[i, j] = block[i, j]
        for j in range(width):
            reach[j] = 0.0 if local else 1.0
        begin, end = (starts[e], starts[e + 1]) if local else (0, where.size)
        for entry in range(begin, end):
            k = where[entry_rows[entry] if local else entry]
            if k < 0:
                continue
            combine(width, ZT[k].ctypes.data, N, seen.ctypes.data, c.ctypes.data)
            if local:
                for j in range(width):
                    c[j] *= tapers[entry, j]
                    reach[j] = max(reach[j], tapers[entry, j])
            spread(width, B[k].ctypes.data, N + 1, c.ctypes.data, block.ctypes.data)
        if inflation != 1.0:
            for j in range(width):
                reach[j] = 1.0 + (inflation - 1.0) * reach[j]
            for i in range(N):
                for j in range(width):
                    block[i, j] *= reach[j]
        store(X, first, count, block)


@jit(parallel=True)
def _sweep_on_threads(context, sensor, X, where, ZT, B, serial, inflation, crews, scratch, each):
    place = place_of(context)
    for crew in prange(crews):
        own = scratch[crew * each : (crew + 1) * each]
        sweep(context_at(place), sensor, X, where, ZT, B, serial, inflation, crew, crews, own)


@jit
def sweep_all(context, sensor, X, where, ZT, B, serial, inflation, crews, scratch):
    """The regression of `sweep` for all states."""
    if crews > 1:
        each = scratch.size // crews
        _sweep_on_threads(context, sensor, X, where, ZT, B, serial, inflation, crews, scratch, each)
    else:
        sweep(context, sensor, X, where, ZT, B, serial, inflation, 0, 1, scratch)
