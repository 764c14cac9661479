"""Vector instructions for the inner loops of large states and ensembles.

Numba's vectoriser is off, as small filters lose by it (see jit.py). Each function here becomes a few instructions on
vectors of 8 numbers, which LLVM splits where the processor's vectors are shorter. The terms of each element are summed
in the same order wherever its block begins, so results are the same bits in any partition of the columns.

All functions take addresses (`array.ctypes.data`), so that calls have no overhead at a length of 8.

Measured on a shared x86-64 machine against plain Numba loops, for 50, 200 and 1,000 numbers: `dot` takes 6 ns for 41,
23 for 163 and 114 for 813; `add_scaled` 9 ns for 14, 27 for 55 and 119 for 271; `exp_minus` 49 ns for 211, 153 for 847
and 765 for 4,270.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from . import simd_ir
from .simd_ir import LANES

WIDE = 32
"""Columns that `combine_wide` and `spread_wide` do at a time: four vectors, which stay in registers."""

_i64, _f64 = types.int64, types.float64


def _combining(width: int) -> Any:
    @intrinsic
    def combine(typing_context: Any, weights: Any, count: Any, x: Any, stride: Any, out: Any) -> Any:
        """out[:] = Σ_k weights[k] x[k·stride :], k < count (at least 1), over all the columns of a block."""

        def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            w, x, out = (simd_ir.pointer(builder, given[k]) for k in (0, 2, 4))
            count, stride = given[1], given[3]
            before = builder.block
            loop, done = builder.append_basic_block("loop"), builder.append_basic_block("done")
            builder.branch(loop)
            builder.position_at_end(loop)
            k = builder.phi(simd_ir.I64)
            k.add_incoming(simd_ir.constant(0), before)
            sums = [builder.phi(simd_ir.VECTOR) for _ in range(width)]
            weight = simd_ir.broadcast(builder, builder.load(builder.gep(w, [k])))
            row = builder.gep(x, [builder.mul(k, stride)])
            added = []
            for v, total in enumerate(sums):
                total.add_incoming(simd_ir.ZERO, before)
                added.append(
                    simd_ir.multiply_add(
                        builder, weight, simd_ir.load(builder, row, simd_ir.constant(v * LANES)), total
                    )
                )
                total.add_incoming(added[-1], loop)
            following = builder.add(k, simd_ir.constant(1))
            k.add_incoming(following, loop)
            builder.cbranch(builder.icmp_signed("<", following, count), loop, done)
            builder.position_at_end(done)
            for v, total in enumerate(added):
                simd_ir.store(builder, total, out, simd_ir.constant(v * LANES))
            return context.get_dummy_value()

        return types.void(_i64, _i64, _i64, _i64, _i64), codegen

    return combine


def _spreading(width: int) -> Any:
    @intrinsic
    def spread(typing_context: Any, weights: Any, count: Any, x: Any, out: Any, stride: Any) -> Any:
        """out[k·stride :] += weights[k] x[:], k < count, over all the columns of a block."""

        def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            w, x, out = (simd_ir.pointer(builder, given[k]) for k in (0, 2, 3))
            values = [simd_ir.load(builder, x, simd_ir.constant(v * LANES)) for v in range(width)]
            with cgutils.for_range(builder, given[1]) as loop:
                weight = simd_ir.broadcast(builder, builder.load(builder.gep(w, [loop.index])))
                row = builder.gep(out, [builder.mul(loop.index, given[4])])
                for v, value in enumerate(values):
                    at = simd_ir.constant(v * LANES)
                    simd_ir.store(
                        builder, simd_ir.multiply_add(builder, weight, value, simd_ir.load(builder, row, at)), row, at
                    )
            return context.get_dummy_value()

        return types.void(_i64, _i64, _i64, _i64, _i64), codegen

    return spread


combine_wide, combine_narrow = _combining(WIDE // LANES), _combining(1)
spread_wide, spread_narrow = _spreading(WIDE // LANES), _spreading(1)


@intrinsic
def add_scaled(typing_context: Any, n: Any, a: Any, x: Any, y: Any) -> Any:
    """y[:n] += a x[:n]."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, a = given[0], given[1]
        x, y = simd_ir.pointer(builder, given[2]), simd_ir.pointer(builder, given[3])
        wide = simd_ir.broadcast(builder, a)

        def whole(i: Any) -> None:
            simd_ir.store(
                builder,
                simd_ir.multiply_add(builder, wide, simd_ir.load(builder, x, i), simd_ir.load(builder, y, i)),
                y,
                i,
            )

        def single(i: Any) -> None:
            at = builder.gep(y, [i])
            builder.store(simd_ir.multiply_add(builder, a, builder.load(builder.gep(x, [i])), builder.load(at)), at)

        simd_ir.in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _f64, _i64, _i64), codegen


@intrinsic
def combine(typing_context: Any, count: Any, weights: Any, apart: Any, x: Any, stride: Any, n: Any, out: Any) -> Any:
    """out[:n] = Σ_k weights[k·apart] x[k·stride :][:n], k < count."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        count, apart, stride, n = given[0], given[2], given[4], given[5]
        w, x, out = (simd_ir.pointer(builder, given[k]) for k in (1, 3, 6))

        def summed(i: Any, zero: Any, load: Any, spread: Any) -> Any:
            sums = cgutils.alloca_once(builder, zero.type)
            builder.store(zero, sums)
            with cgutils.for_range(builder, count) as loop:
                weight = builder.load(builder.gep(w, [builder.mul(loop.index, apart)]))
                row = builder.gep(x, [builder.mul(loop.index, stride)])
                builder.store(simd_ir.multiply_add(builder, spread(weight), load(row), builder.load(sums)), sums)
            return builder.load(sums)

        def whole(i: Any) -> None:
            zero = simd_ir.ZERO
            added = summed(
                i, zero, lambda row: simd_ir.load(builder, row, i), lambda weight: simd_ir.broadcast(builder, weight)
            )
            simd_ir.store(builder, added, out, i)

        def single(i: Any) -> None:
            zero = ir.Constant(simd_ir.F64, 0.0)
            added = summed(i, zero, lambda row: builder.load(builder.gep(row, [i])), lambda weight: weight)
            builder.store(added, builder.gep(out, [i]))

        simd_ir.in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _i64, _i64, _i64, _i64, _i64), codegen


@intrinsic
def combine_four(
    typing_context: Any,
    count: Any,
    weights: Any,
    apart: Any,
    x: Any,
    stride: Any,
    n: Any,
    out: Any,
    width: Any,
) -> Any:
    """out[i·width :][:n] = Σ_k weights[k·apart + i] x[k·stride :][:n], k < count, for i < 4; the bits of `combine`."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        count, apart, stride, n, width = (given[k] for k in (0, 2, 4, 5, 7))
        w, x, out = (simd_ir.pointer(builder, given[k]) for k in (1, 3, 6))

        def summed(kind: Any, load: Any, spread: Any, store: Any) -> None:
            sums = [cgutils.alloca_once(builder, kind) for _ in range(4)]
            for one in sums:
                builder.store(ir.Constant(kind, [0.0] * LANES if isinstance(kind, ir.VectorType) else 0.0), one)
            with cgutils.for_range(builder, count) as loop:
                weight = builder.gep(w, [builder.mul(loop.index, apart)])
                value = load(builder.gep(x, [builder.mul(loop.index, stride)]))
                for i, one in enumerate(sums):
                    own = spread(builder.load(builder.gep(weight, [simd_ir.constant(i)])))
                    builder.store(simd_ir.multiply_add(builder, own, value, builder.load(one)), one)
            for i, one in enumerate(sums):
                store(builder.load(one), builder.gep(out, [builder.mul(width, simd_ir.constant(i))]))

        def whole(at: Any) -> None:
            summed(
                simd_ir.VECTOR,
                lambda row: simd_ir.load(builder, row, at),
                lambda weight: simd_ir.broadcast(builder, weight),
                lambda value, row: simd_ir.store(builder, value, row, at),
            )

        def single(at: Any) -> None:
            summed(
                simd_ir.F64,
                lambda row: builder.load(builder.gep(row, [at])),
                lambda weight: weight,
                lambda value, row: builder.store(value, builder.gep(row, [at])),
            )

        simd_ir.in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _i64, _i64, _i64, _i64, _i64, _i64), codegen


@intrinsic
def add_outer(
    typing_context: Any,
    rows: Any,
    n: Any,
    a: Any,
    left: Any,
    x: Any,
    right: Any,
    y: Any,
    z: Any,
    stride: Any,
) -> Any:
    """z[k·stride :][:n] += a (left[k] x[:n] + right[k] y[:n]) for k < rows."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        rows, n, a, stride = (given[k] for k in (0, 1, 2, 8))
        left, x, right, y, z = (simd_ir.pointer(builder, given[k]) for k in (3, 4, 5, 6, 7))

        def added(own_x: Any, own_y: Any, load: Any, spread: Any, store: Any) -> None:
            own_x, own_y = builder.fmul(spread(a), own_x), builder.fmul(spread(a), own_y)
            with cgutils.for_range(builder, rows) as loop:
                row = builder.gep(z, [builder.mul(loop.index, stride)])
                one, other = (spread(builder.load(builder.gep(side, [loop.index]))) for side in (left, right))
                first = simd_ir.multiply_add(builder, one, own_x, load(row))
                store(simd_ir.multiply_add(builder, other, own_y, first), row)

        def whole(i: Any) -> None:
            added(
                simd_ir.load(builder, x, i),
                simd_ir.load(builder, y, i),
                lambda row: simd_ir.load(builder, row, i),
                lambda number: simd_ir.broadcast(builder, number),
                lambda value, row: simd_ir.store(builder, value, row, i),
            )

        def single(i: Any) -> None:
            added(
                builder.load(builder.gep(x, [i])),
                builder.load(builder.gep(y, [i])),
                lambda row: builder.load(builder.gep(row, [i])),
                lambda number: number,
                lambda value, row: builder.store(value, builder.gep(row, [i])),
            )

        simd_ir.in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _f64, _i64, _i64, _i64, _i64, _i64, _i64), codegen


@intrinsic
def rotate(typing_context: Any, n: Any, c: Any, s: Any, x: Any, y: Any) -> Any:
    """x[:n], y[:n] = c x - s y, s x + c y."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, c, s = given[:3]
        x, y = simd_ir.pointer(builder, given[3]), simd_ir.pointer(builder, given[4])
        wide_c, wide_s = simd_ir.broadcast(builder, c), simd_ir.broadcast(builder, s)

        def turned(c: Any, s: Any, a: Any, b: Any) -> tuple[Any, Any]:
            left = simd_ir.multiply_add(builder, c, a, builder.fneg(builder.fmul(s, b)))
            return left, simd_ir.multiply_add(builder, s, a, builder.fmul(c, b))

        def whole(i: Any) -> None:
            left, right = turned(wide_c, wide_s, simd_ir.load(builder, x, i), simd_ir.load(builder, y, i))
            simd_ir.store(builder, left, x, i)
            simd_ir.store(builder, right, y, i)

        def single(i: Any) -> None:
            at_x, at_y = builder.gep(x, [i]), builder.gep(y, [i])
            left, right = turned(c, s, builder.load(at_x), builder.load(at_y))
            builder.store(left, at_x)
            builder.store(right, at_y)

        simd_ir.in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _f64, _f64, _i64, _i64), codegen


def _summing(builder: Any, n: Any, whole: Any, single: Any) -> Any:
    """Σ over n numbers, by vectors: total = whole(i, total) for the full ones, then single(i, sum) for the rest."""
    wide, narrow = cgutils.alloca_once(builder, simd_ir.VECTOR), cgutils.alloca_once(builder, simd_ir.F64)
    builder.store(simd_ir.ZERO, wide)
    builder.store(ir.Constant(simd_ir.F64, 0.0), narrow)
    simd_ir.in_vectors(
        builder,
        n,
        lambda i: builder.store(whole(i, builder.load(wide)), wide),
        lambda i: builder.store(single(i, builder.load(narrow)), narrow),
    )
    return builder.fadd(simd_ir.sum_of(builder, builder.load(wide)), builder.load(narrow))


@intrinsic
def total(typing_context: Any, n: Any, x: Any) -> Any:
    """Σ x[:n]."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        x = simd_ir.pointer(builder, given[1])
        return _summing(
            builder,
            given[0],
            lambda i, sums: builder.fadd(sums, simd_ir.load(builder, x, i)),
            lambda i, sums: builder.fadd(sums, builder.load(builder.gep(x, [i]))),
        )

    return _f64(_i64, _i64), codegen


@intrinsic
def dot(typing_context: Any, n: Any, a: Any, b: Any) -> Any:
    """Σ a[:n] b[:n]."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        a, b = simd_ir.pointer(builder, given[1]), simd_ir.pointer(builder, given[2])
        return _summing(
            builder,
            given[0],
            lambda i, total: simd_ir.multiply_add(
                builder, simd_ir.load(builder, a, i), simd_ir.load(builder, b, i), total
            ),
            lambda i, total: simd_ir.multiply_add(
                builder, builder.load(builder.gep(a, [i])), builder.load(builder.gep(b, [i])), total
            ),
        )

    return _f64(_i64, _i64, _i64), codegen


@intrinsic
def weighted(typing_context: Any, n: Any, w: Any, x: Any, out: Any) -> Any:
    """out[:n] = w[:n] x[:n]; returns Σ out[:n]."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        w, x, out = (simd_ir.pointer(builder, given[k]) for k in (1, 2, 3))

        def whole(i: Any, total: Any) -> Any:
            value = builder.fmul(simd_ir.load(builder, w, i), simd_ir.load(builder, x, i))
            simd_ir.store(builder, value, out, i)
            return builder.fadd(total, value)

        def single(i: Any, total: Any) -> Any:
            value = builder.fmul(builder.load(builder.gep(w, [i])), builder.load(builder.gep(x, [i])))
            builder.store(value, builder.gep(out, [i]))
            return builder.fadd(total, value)

        return _summing(builder, given[0], whole, single)

    return _f64(_i64, _i64, _i64, _i64), codegen


@intrinsic
def exp_minus(typing_context: Any, n: Any, x: Any, shift: Any, out: Any) -> Any:
    """out[:n] = e^(x[:n] - shift), within a unit in the last place; 0 where it is below the normal numbers."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, shift = given[0], given[2]
        x, out = simd_ir.pointer(builder, given[1]), simd_ir.pointer(builder, given[3])
        wide = simd_ir.broadcast(builder, shift)

        def whole(i: Any) -> None:
            simd_ir.store(
                builder, simd_ir.exponential(builder, builder.fsub(simd_ir.load(builder, x, i), wide)), out, i
            )

        def single(i: Any) -> None:
            value = simd_ir.exponential(builder, builder.fsub(builder.load(builder.gep(x, [i])), shift))
            builder.store(value, builder.gep(out, [i]))

        simd_ir.in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _f64, _i64), codegen
