"""Vector code for small matrices with rows padded to full vectors, for the Gaussian filters.

Padding is never part of a result.

Measured on a shared x86-64 machine against plain Numba loops, for 2, 4, 7, 16 and 48 states: a covariance of sigma
points takes 6 ns for 17, 16 for 99, 37 for 463, 310 for 2,640 and 8,000 for 65,000; a factor 11 ns for 16, 33 for 48,
61 for 125, 300 for 700 and 3,900 for 10,900. With the products in blocks a step of the Kalman filter takes 1.1 µs for
1.6 with 8 states, 3.2 for 13.9 with 24 and 9.8 for 84 with 48.
"""

from __future__ import annotations

import functools
import math

from numba import types
from numba.core import cgutils

from .simd_ir import I64, LANES, Array, Lanes, Value, integer, sizes, steps, vector_code


@vector_code()
def centre(v, D, k, w, mean):
    """Turn points D (rows, padded k) into deviations from mean = D₀ + w Σ (Dᵢ - D₀), (padded k,).

    The padding becomes zero: left alone, it would shrink from call to call to subnormal numbers, which take a hundred
    times as long.
    """
    builder, x = v.builder, D.data
    rows, width = sizes(builder, D)
    sums = v.variable()
    with steps(builder, 0, width, LANES) as at:
        own = v.first(builder.sub(k, at))

        def load(row: Value) -> Value:
            return builder.select(own, v.load(row, at), v.constant(0.0))

        central = load(x)
        builder.store(v.constant(0.0), sums)
        with steps(builder, 1, rows) as r:
            v.add_to(sums, builder.fsub(load(builder.gep(x, [builder.mul(r, width)])), central))
        shift = builder.fmul(v.spread(w), builder.load(sums))
        v.store(builder.fadd(central, shift), mean.data, at)
        with steps(builder, 1, rows) as r:
            row = builder.gep(x, [builder.mul(r, width)])
            v.store(builder.fsub(builder.fsub(load(row), central), shift), row, at)
        v.store(builder.fsub(v.constant(0.0), shift), x, at)


def _product(v: Lanes, n: Value, rows: Value, A: Array, B: Array, first: Value, w: Value, out: Array) -> None:
    """Write out (n, columns) = first A₀ᵀ B₀ + w Σ_r A_rᵀ B_r over the rows A_r (n or more) and B_r (whole vectors).

    Where A is B it is symmetric to the last bit.
    """
    builder, a, b = v.builder, A.data, B.data
    a_width, b_width, columns = sizes(builder, A)[1], sizes(builder, B)[1], sizes(builder, out)[1]
    first, weight = v.spread(first), v.spread(w)
    sums = [v.variable() for _ in range(4)]

    def entries(row: Value, i: Value, count: int) -> list[Value]:
        return [v.entry(row, builder.add(i, integer(k))) for k in range(count)]

    def tile(i: Value, at: Value, count: int) -> None:
        """Rows i, …, i + count - 1 of one vector's columns."""
        mine = sums[:count]
        for one in mine:
            builder.store(v.constant(0.0), one)
        with steps(builder, 1, rows) as r:
            row = v.load(builder.gep(b, [builder.mul(r, b_width)]), at)
            own = entries(builder.gep(a, [builder.mul(r, a_width)]), i, count)
            for one, entry in zip(mine, own, strict=True):
                v.multiply_add_to(one, entry, row)
        zeroth = v.load(b, at)
        mask = v.first(builder.sub(columns, at))
        for k, (one, entry) in enumerate(zip(mine, entries(a, i, count), strict=True)):
            own = builder.fmul(first, builder.fmul(entry, zeroth))
            to = builder.gep(out.data, [builder.mul(builder.add(i, integer(k)), columns)])
            v.store_first(builder.fadd(builder.fmul(weight, builder.load(one)), own), to, at, mask)

    begin = integer(0)
    for count in (4, 2, 1):
        end = builder.and_(n, integer(-count))
        with steps(builder, begin, end, count) as i, steps(builder, 0, b_width, LANES) as at:
            tile(i, at, count)
        begin = end


@vector_code()
def covariance(v, D, first, w, P):
    """P (k, k) = first D₀ᵀ D₀ + w Σ Dᵢᵀ Dᵢ, from deviations D (2n+1, padded k)."""
    _product(v, sizes(v.builder, P)[0], sizes(v.builder, D)[0], D, D, first, w, P)


@vector_code()
def cross_covariance(v, U, across, w, C):
    """C (n, m) = w Σ U[k]ᵀ across[k], with differences `across` (n, padded m) between opposite points."""
    n = sizes(v.builder, C)[0]
    _product(v, n, n, U, across, w, w, C)


@vector_code()
def subtract_squares(v, W, m, rows, P):
    """Leading rows of P (n, n) -= those of Wᵀ W, of the leading m rows of W (m or more, padded n).

    A symmetric P stays so, bit by bit, if these are all of its rows.
    """
    builder, w, n, width = v.builder, W.data, sizes(v.builder, P)[0], sizes(v.builder, W)[1]
    left = v.variable()
    with steps(builder, 0, width, LANES) as at:
        own = v.first(builder.sub(n, at))
        with cgutils.for_range(builder, rows) as loop:
            to = builder.gep(P.data, [builder.mul(loop.index, n)])
            builder.store(v.load_first(to, at, own), left)
            with cgutils.for_range(builder, m) as inner:
                row = builder.gep(w, [builder.mul(inner.index, width)])
                factor = v.spread(builder.fneg(builder.load(builder.gep(row, [loop.index]))))
                v.multiply_add_to(left, factor, v.load(row, at))
            v.store_first(builder.load(left), to, at, own)


@vector_code(types.boolean)
def factor(v, P, U):
    """Upper U (n, padded n) with Uᵀ U = P (n, n); return False if P is not positive definite.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., algorithm 4.2.2 (outer product form).
    """
    builder, one_number = v.builder, Lanes(v.builder, wide=False)
    n, (_, width), u = sizes(builder, P)[0], sizes(builder, U), U.data
    good = cgutils.alloca_once_value(builder, cgutils.true_bit)
    zero, one = one_number.constant(0.0), one_number.constant(1.0)

    with cgutils.for_range(builder, n) as loop, steps(builder, 0, width, LANES) as at:
        row = builder.gep(P.data, [builder.mul(loop.index, n)])
        value = v.load_first(row, at, v.first(builder.sub(n, at)))
        v.store(value, builder.gep(u, [builder.mul(loop.index, width)]), at)
    with cgutils.for_range(builder, n) as loop:
        k = loop.index
        row = builder.gep(u, [builder.mul(k, width)])
        pivot = builder.load(builder.gep(row, [k]))
        positive = builder.fcmp_ordered(">", pivot, zero)
        finite = builder.fcmp_ordered("<", pivot, one_number.constant(math.inf))
        builder.store(builder.and_(builder.load(good), builder.and_(positive, finite)), good)
        # The next pivot waits for a division only; the root is not in its way.
        inverse = builder.fneg(builder.fdiv(one, pivot))
        scale = v.spread(builder.fdiv(one, one_number.unary("sqrt", pivot)))
        begin = builder.and_(k, integer(-LANES))
        with steps(builder, builder.add(k, integer(1)), n) as i:
            multiple = v.spread(builder.fmul(builder.load(builder.gep(row, [i])), inverse))
            other = builder.gep(u, [builder.mul(i, width)])
            with steps(builder, begin, width, LANES) as at:
                v.store(v.multiply_add(multiple, v.load(row, at), v.load(other, at)), other, at)
        with steps(builder, 0, width, LANES) as at:
            # Clear the remainders of elimination below the diagonal.
            left = v.first(builder.sub(k, at))
            v.store(builder.select(left, v.constant(0.0), builder.fmul(scale, v.load(row, at))), row, at)
    return builder.load(good)


@vector_code()
def spread_points(v, x, U, spread, points):
    """Fill `points` (2n+1, padded n) with x and x ± spread·U[k]."""
    builder = v.builder
    (n,), (_, width), apart = sizes(builder, x), sizes(builder, points), sizes(builder, U)[1]
    spread, half = v.spread(spread), builder.mul(n, width)
    with steps(builder, 0, width, LANES) as at:
        own = v.first(builder.sub(n, at))
        centre = v.load_first(x.data, at, own)
        v.store(centre, points.data, at)
        with cgutils.for_range(builder, n) as loop:
            row = builder.gep(U.data, [builder.mul(loop.index, apart)])
            d = builder.fmul(spread, v.load_first(row, at, own))
            to = builder.add(builder.mul(builder.add(loop.index, integer(1)), width), at)
            v.store(builder.fadd(centre, d), points.data, to)
            v.store(builder.fsub(centre, d), points.data, builder.add(to, half))


def _multiply(
    v: Lanes, A: Array, rows: Value, count: Value, B: Array, base: Array | None, out: Array, lower: Value
) -> None:
    """Write out = A B, or base - A B, in blocks of four rows and one or two vectors that stay in registers.

    The last block of rows and of columns overlaps the one before it instead of being shorter.
    """
    builder = v.builder
    lower = builder.icmp_signed("!=", lower, integer(0))

    def least(a: Value, b: Value) -> Value:
        return builder.select(builder.icmp_signed("<", a, b), a, b)

    n = least(sizes(builder, B)[1], sizes(builder, out)[1])

    def row_of(array: Array, row: Value) -> Value:
        return builder.gep(array.data, [builder.mul(row, sizes(builder, array)[1])])

    def block(i: Value, at: Value, height: int, vectors: int) -> None:
        columns = [builder.add(at, integer(LANES * c)) for c in range(vectors)]
        rows = [builder.add(i, integer(r)) for r in range(height)]
        left = [row_of(A, row) for row in rows]
        sums = [[v.variable() for _ in columns] for _ in rows]
        for row, mine in zip(rows, sums, strict=True):
            for column, one in zip(columns, mine, strict=True):
                builder.store(v.constant(0.0) if base is None else v.load(row_of(base, row), column), one)
        with cgutils.for_range(builder, count) as loop:
            entries = [builder.gep(row, [loop.index]) for row in left]
            used = cgutils.true_bit
            if base is None:
                # Twice the bits, so without the sign: 0 for zeros only.
                bits = [builder.load(builder.bitcast(entry, I64.as_pointer())) for entry in entries]
                used = builder.icmp_unsigned(
                    "!=", builder.shl(functools.reduce(builder.or_, bits), integer(1)), integer(0)
                )
            with builder.if_then(used):
                row = row_of(B, loop.index)
                values = [v.load(row, column) for column in columns]
                for entry, mine in zip(entries, sums, strict=True):
                    number = builder.load(entry)
                    weight = v.spread(number if base is None else builder.fneg(number))
                    for value, one in zip(values, mine, strict=True):
                        v.multiply_add_to(one, weight, value)
        for row, mine in zip(rows, sums, strict=True):
            for column, one in zip(columns, mine, strict=True):
                v.store(builder.load(one), row_of(out, row), column)

    def blocks(height: int, vectors: int) -> None:
        last = builder.sub(n, integer(LANES * vectors))
        with steps(builder, 0, rows, height) as row:
            i = least(row, builder.sub(rows, integer(height)))
            end = builder.select(lower, builder.add(i, integer(height)), n)
            with steps(builder, 0, end, LANES * vectors) as column:
                block(i, least(column, last), height, vectors)

    with builder.if_else(builder.icmp_signed("<", rows, integer(4))) as cases:
        for case, height in zip(cases, (1, 4), strict=True):
            with case, builder.if_else(builder.icmp_signed("<", n, integer(2 * LANES))) as widths:
                for width, vectors in zip(widths, (1, 2), strict=True):
                    with width:
                        blocks(height, vectors)


@vector_code()
def multiply_rows(v, A, rows, count, B, lower, out):
    """Leading rows of out (rows or more, n) = A B over `count` columns of A and rows of B (count or more, n).

    B or out may be wider than n, which is 8 or more. Zeros of A are skipped. If `lower`, entries above the diagonal are
    undefined.
    """
    _multiply(v, A, rows, count, B, None, out, lower)


@vector_code()
def subtract_product(v, base, A, rows, count, B, lower, out):
    """Leading rows of out (rows or more, n) = base - A B; otherwise as `multiply_rows`."""
    _multiply(v, A, rows, count, B, base, out, lower)
