"""Small matrices with rows padded to full vectors, for the unscented filters: factor, sigma points, covariances.

Padding is never part of a result. The functions at the end take arrays; those in LLVM take addresses, as in simd.py.

Measured on a shared x86-64 machine against plain Numba loops, for 2, 4, 7, 16 and 48 states: a covariance of sigma
points takes 6 ns for 17, 16 for 99, 37 for 463, 310 for 2,640 and 8,000 for 65,000; a factor 11 ns for 16, 33 for 48,
61 for 125, 300 for 700 and 3,900 for 10,900.
"""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from . import simd_ir
from .jit import inlined
from .simd_ir import LANES

_i64, _f64 = types.int64, types.float64


@intrinsic
def centre_at(typing_context: Any, rows: Any, k: Any, width: Any, x: Any, w: Any, mean: Any) -> Any:
    """Rows of k numbers, `width` apart (whole vectors), become deviations from mean = x₀ + w Σ_r (x_r - x₀).

    What stands behind the k numbers becomes zero: left alone, it would shrink from call to call to subnormal numbers,
    which take a hundred times as long.
    """

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        rows, k, width = given[:3]
        x, mean = simd_ir.pointer(builder, given[3]), simd_ir.pointer(builder, given[5])
        weight = simd_ir.broadcast(builder, given[4])
        nothing = simd_ir.ZERO
        lanes = ir.Constant(ir.VectorType(simd_ir.I64, LANES), list(range(LANES)))
        sums = cgutils.alloca_once(builder, simd_ir.VECTOR)

        def others(body: Any) -> None:
            with simd_ir.steps(builder, 1, rows) as r:
                body(builder.gep(x, [builder.mul(r, width)]))

        with simd_ir.steps(builder, 0, width, LANES) as at:
            own = builder.icmp_signed("<", lanes, simd_ir.broadcast(builder, builder.sub(k, at)))

            def load(row: Any) -> Any:
                return builder.select(own, simd_ir.load(builder, row, at), nothing)

            central = load(x)
            builder.store(nothing, sums)

            def add(row: Any) -> None:
                builder.store(builder.fadd(builder.load(sums), builder.fsub(load(row), central)), sums)

            others(add)
            shift = builder.fmul(weight, builder.load(sums))
            simd_ir.store(builder, builder.fadd(central, shift), mean, at)

            def deviate(row: Any) -> None:
                simd_ir.store(builder, builder.fsub(builder.fsub(load(row), central), shift), row, at)

            others(deviate)
            simd_ir.store(builder, builder.fsub(nothing, shift), x, at)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _i64, _i64, _f64, _i64), codegen


@intrinsic
def product(
    typing_context: Any,
    n: Any,
    rows: Any,
    a: Any,
    a_width: Any,
    b: Any,
    b_width: Any,
    first: Any,
    w: Any,
    out: Any,
    columns: Any,
) -> Any:
    """out (n, columns) = first a₀ᵀ b₀ + w Σ_r a_rᵀ b_r over the rows a_r (n or more) and b_r (whole vectors).

    Where a is b it is symmetric to the last bit.
    """

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, rows, a_width, b_width, columns = (given[k] for k in (0, 1, 3, 5, 9))
        a, b, out = (simd_ir.pointer(builder, given[k]) for k in (2, 4, 8))
        first, weight = simd_ir.broadcast(builder, given[6]), simd_ir.broadcast(builder, given[7])
        sums = [cgutils.alloca_once(builder, simd_ir.VECTOR) for _ in range(4)]

        def entries(row: Any, i: Any, count: int) -> list[Any]:
            return [
                simd_ir.broadcast(builder, builder.load(builder.gep(row, [builder.add(i, simd_ir.constant(k))])))
                for k in range(count)
            ]

        def tile(i: Any, at: Any, count: int) -> None:
            """Rows i, …, i + count - 1 of one vector's columns."""
            mine = sums[:count]
            for one in mine:
                builder.store(simd_ir.ZERO, one)
            with simd_ir.steps(builder, 1, rows) as r:
                row = simd_ir.load(builder, builder.gep(b, [builder.mul(r, b_width)]), at)
                own = entries(builder.gep(a, [builder.mul(r, a_width)]), i, count)
                for one, entry in zip(mine, own, strict=True):
                    builder.store(simd_ir.multiply_add(builder, entry, row, builder.load(one)), one)
            zeroth = simd_ir.load(builder, b, at)
            mask = simd_ir.first(builder, builder.sub(columns, at))
            for k, (one, entry) in enumerate(zip(mine, entries(a, i, count), strict=True)):
                own = builder.fmul(first, builder.fmul(entry, zeroth))
                whole = builder.fadd(builder.fmul(weight, builder.load(one)), own)
                to = builder.gep(out, [builder.mul(builder.add(i, simd_ir.constant(k)), columns)])
                simd_ir.store_first(builder, whole, to, at, mask)

        begin = simd_ir.constant(0)
        for count in (4, 2, 1):
            end = builder.and_(n, simd_ir.constant(-count))
            with simd_ir.steps(builder, begin, end, count) as i:
                with simd_ir.steps(builder, 0, b_width, LANES) as at:
                    tile(i, at, count)
            begin = end
        return context.get_dummy_value()

    return types.void(_i64, _i64, _i64, _i64, _i64, _i64, _f64, _f64, _i64, _i64), codegen


@intrinsic
def subtract_squares_at(typing_context: Any, n: Any, rows: Any, w: Any, width: Any, p: Any) -> Any:
    """P (n, n) -= Σ_k w_kᵀ w_k over rows w_k, `width` apart (whole vectors); what is symmetric stays so, bit by bit."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, rows, width = given[0], given[1], given[3]
        w, p = simd_ir.pointer(builder, given[2]), simd_ir.pointer(builder, given[4])
        left = cgutils.alloca_once(builder, simd_ir.VECTOR)
        with simd_ir.steps(builder, 0, width, LANES) as at:
            own = simd_ir.first(builder, builder.sub(n, at))
            with cgutils.for_range(builder, n) as loop:
                to = builder.gep(p, [builder.mul(loop.index, n)])
                builder.store(simd_ir.load_first(builder, to, at, own), left)
                with cgutils.for_range(builder, rows) as inner:
                    row = builder.gep(w, [builder.mul(inner.index, width)])
                    factor = simd_ir.broadcast(builder, builder.fneg(builder.load(builder.gep(row, [loop.index]))))
                    builder.store(
                        simd_ir.multiply_add(builder, factor, simd_ir.load(builder, row, at), builder.load(left)), left
                    )
                simd_ir.store_first(builder, builder.load(left), to, at, own)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _i64, _i64, _i64), codegen


@intrinsic
def factor_rows(typing_context: Any, n: Any, a: Any, u: Any, width: Any) -> Any:
    """Upper U with Uᵀ U = A (n, n), its rows `width` apart (whole vectors): 1, or 0 if A is not positive definite.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., algorithm 4.2.2 (outer product form).
    """

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, width = given[0], given[3]
        a, u = (simd_ir.pointer(builder, given[k]) for k in (1, 2))
        good = cgutils.alloca_once(builder, simd_ir.I64)
        builder.store(simd_ir.constant(1), good)
        one, nothing = ir.Constant(simd_ir.F64, 1.0), simd_ir.ZERO
        root = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(simd_ir.F64, [simd_ir.F64]), "llvm.sqrt.f64"
        )

        def columns(first: Any) -> Any:
            return simd_ir.steps(builder, first, width, LANES)

        with cgutils.for_range(builder, n) as loop, columns(0) as at:
            row = builder.gep(a, [builder.mul(loop.index, n)])
            value = simd_ir.load_first(builder, row, at, simd_ir.first(builder, builder.sub(n, at)))
            simd_ir.store(builder, value, builder.gep(u, [builder.mul(loop.index, width)]), at)
        with cgutils.for_range(builder, n) as loop:
            k = loop.index
            row = builder.gep(u, [builder.mul(k, width)])
            pivot = builder.load(builder.gep(row, [k]))
            positive = builder.fcmp_ordered(">", pivot, ir.Constant(simd_ir.F64, 0.0))
            finite = builder.fcmp_ordered("<", pivot, ir.Constant(simd_ir.F64, math.inf))
            both = builder.zext(builder.and_(positive, finite), simd_ir.I64)
            builder.store(builder.and_(builder.load(good), both), good)
            # The next pivot waits for a division only; the root is off its way.
            inverse = builder.fneg(builder.fdiv(one, pivot))
            scale = simd_ir.broadcast(builder, builder.fdiv(one, builder.call(root, [pivot])))
            begin = builder.and_(k, simd_ir.constant(-LANES))
            with simd_ir.steps(builder, builder.add(k, simd_ir.constant(1)), n) as i:
                factor = simd_ir.broadcast(builder, builder.fmul(builder.load(builder.gep(row, [i])), inverse))
                other = builder.gep(u, [builder.mul(i, width)])
                with columns(begin) as at:
                    value = simd_ir.multiply_add(
                        builder, factor, simd_ir.load(builder, row, at), simd_ir.load(builder, other, at)
                    )
                    simd_ir.store(builder, value, other, at)
            with columns(0) as at:
                # What elimination left of zeros is cleared.
                left = simd_ir.first(builder, builder.sub(k, at))
                simd_ir.store(
                    builder, builder.select(left, nothing, builder.fmul(scale, simd_ir.load(builder, row, at))), row, at
                )
        return builder.load(good)

    return _i64(_i64, _i64, _i64, _i64), codegen


@intrinsic
def around(typing_context: Any, n: Any, x: Any, u: Any, apart: Any, spread: Any, points: Any, width: Any) -> Any:
    """points (2n + 1, width) = x, x + spread u_k, x - spread u_k with rows u_k (n,) that are `apart`."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, apart, width = given[0], given[3], given[6]
        x, u, points = (simd_ir.pointer(builder, given[k]) for k in (1, 2, 5))
        spread = simd_ir.broadcast(builder, given[4])
        half = builder.mul(n, width)
        with simd_ir.steps(builder, 0, width, LANES) as at:
            own = simd_ir.first(builder, builder.sub(n, at))
            centre = simd_ir.load_first(builder, x, at, own)
            simd_ir.store(builder, centre, points, at)
            with cgutils.for_range(builder, n) as loop:
                row = builder.gep(u, [builder.mul(loop.index, apart)])
                d = builder.fmul(spread, simd_ir.load_first(builder, row, at, own))
                to = builder.add(builder.mul(builder.add(loop.index, simd_ir.constant(1)), width), at)
                simd_ir.store(builder, builder.fadd(centre, d), points, to)
                simd_ir.store(builder, builder.fsub(centre, d), points, builder.add(to, half))
        return context.get_dummy_value()

    return types.void(_i64, _i64, _i64, _i64, _f64, _i64, _i64), codegen


@inlined
def factor(P, U):
    """Upper U (n, padded n) with Uᵀ U = P (n, n); False if P is not positive definite."""
    return factor_rows(P.shape[0], P.ctypes.data, U.ctypes.data, U.shape[1]) != 0


@inlined
def spread_points(x, U, spread, points):
    """Fill `points` (2n+1, padded n) with x and x ± spread·U[k]."""
    around(x.size, x.ctypes.data, U.ctypes.data, U.shape[1], spread, points.ctypes.data, points.shape[1])


@inlined
def centre(D, k, w, mean):
    """Turn points D (2n+1, padded k) into deviations from mean = D₀ + w Σ (Dᵢ - D₀), (padded k,)."""
    centre_at(D.shape[0], k, D.shape[1], D.ctypes.data, w, mean.ctypes.data)


@inlined
def covariance(D, first, w, P):
    """P (k, k) = first D₀ᵀ D₀ + w Σ Dᵢᵀ Dᵢ, from deviations D (2n+1, padded k)."""
    rows, width = D.shape
    k = P.shape[0]
    product(k, rows, D.ctypes.data, width, D.ctypes.data, width, first, w, P.ctypes.data, k)


@inlined
def cross_covariance(U, across, w, C):
    """C (n, m) = w Σ U[k]ᵀ across[k], with differences `across` (n, padded m) between opposite points."""
    n, m = C.shape
    product(n, n, U.ctypes.data, U.shape[1], across.ctypes.data, across.shape[1], w, w, C.ctypes.data, m)


@inlined
def subtract_squares(W, m, P):
    """P (n, n) -= Wᵀ W, of the leading m rows of W (m or more, padded n)."""
    subtract_squares_at(P.shape[0], m, W.ctypes.data, W.shape[1], P.ctypes.data)
