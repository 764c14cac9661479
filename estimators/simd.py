"""Vector instructions, spelled out, for the loops in which filters of large states and ensembles spend their time.

Numba's own vectoriser is off (see `jit.py`: small filters lose by it). Each function here becomes a few instructions
on vectors of 8 numbers, which LLVM splits where the processor's are shorter. An element's sum runs in the same order
wherever its block begins, so results are the same bits in any partition of the columns.

All take addresses (`array.ctypes.data`), which is what makes them free of overhead at a length of 8.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8
"""Numbers in a vector."""

WIDE = 32
"""Columns that `combine_wide` and `spread_wide` do at a time: four vectors, which stay in registers."""

_I32, _I64, _F64 = ir.IntType(32), ir.IntType(64), ir.DoubleType()
_VECTOR = ir.VectorType(_F64, LANES)
_i64, _f64 = types.int64, types.float64


def _count(number: int) -> Any:
    return ir.Constant(_I64, number)


def _pointer(builder: Any, address: Any) -> Any:
    return builder.inttoptr(address, _F64.as_pointer())


def _at(builder: Any, pointer: Any, index: Any) -> Any:
    """The address of the vector that begins at pointer[index]; it need not be aligned to more than a number."""
    return builder.bitcast(builder.gep(pointer, [index]), _VECTOR.as_pointer())


def _load(builder: Any, pointer: Any, index: Any) -> Any:
    return builder.load(_at(builder, pointer, index), align=8)


def _store(builder: Any, value: Any, pointer: Any, index: Any) -> None:
    builder.store(value, _at(builder, pointer, index), align=8)


def _broadcast(builder: Any, value: Any) -> Any:
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES))


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    kind = c.type
    name = "llvm.fmuladd.f64" if kind == _F64 else f"llvm.fmuladd.v{LANES}f64"
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind] * 3), name)
    return builder.call(function, [a, b, c])


def _combining(vectors: int) -> Any:
    @intrinsic
    def combine(typing_context: Any, weights: Any, count: Any, x: Any, stride: Any, out: Any) -> Any:
        """out[:] = Σ_k weights[k] x[k·stride :], k < count (at least 1), over all the columns of a block."""

        def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            w, x, out = (_pointer(builder, given[k]) for k in (0, 2, 4))
            count, stride = given[1], given[3]
            before = builder.block
            loop, done = builder.append_basic_block("loop"), builder.append_basic_block("done")
            builder.branch(loop)
            builder.position_at_end(loop)
            k = builder.phi(_I64)
            k.add_incoming(_count(0), before)
            sums = [builder.phi(_VECTOR) for _ in range(vectors)]
            weight = _broadcast(builder, builder.load(builder.gep(w, [k])))
            row = builder.gep(x, [builder.mul(k, stride)])
            added = []
            for v, total in enumerate(sums):
                total.add_incoming(ir.Constant(_VECTOR, [0.0] * LANES), before)
                added.append(_multiply_add(builder, weight, _load(builder, row, _count(v * LANES)), total))
                total.add_incoming(added[-1], loop)
            following = builder.add(k, _count(1))
            k.add_incoming(following, loop)
            builder.cbranch(builder.icmp_signed("<", following, count), loop, done)
            builder.position_at_end(done)
            for v, total in enumerate(added):
                _store(builder, total, out, _count(v * LANES))
            return context.get_dummy_value()

        return types.void(_i64, _i64, _i64, _i64, _i64), codegen

    return combine


def _spreading(vectors: int) -> Any:
    @intrinsic
    def spread(typing_context: Any, weights: Any, count: Any, x: Any, out: Any, stride: Any) -> Any:
        """out[k·stride :] += weights[k] x[:], k < count, over all the columns of a block."""

        def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            w, x, out = (_pointer(builder, given[k]) for k in (0, 2, 3))
            values = [_load(builder, x, _count(v * LANES)) for v in range(vectors)]
            with cgutils.for_range(builder, given[1]) as loop:
                weight = _broadcast(builder, builder.load(builder.gep(w, [loop.index])))
                row = builder.gep(out, [builder.mul(loop.index, given[4])])
                for v, value in enumerate(values):
                    at = _count(v * LANES)
                    _store(builder, _multiply_add(builder, weight, value, _load(builder, row, at)), row, at)
            return context.get_dummy_value()

        return types.void(_i64, _i64, _i64, _i64, _i64), codegen

    return spread


combine_wide, combine_narrow = _combining(WIDE // LANES), _combining(1)
spread_wide, spread_narrow = _spreading(WIDE // LANES), _spreading(1)


def _in_vectors(builder: Any, n: Any, whole: Any, single: Any) -> None:
    """whole(i) for each full vector of n numbers, then single(i) for each number of the rest."""
    full = builder.and_(n, _count(-LANES))
    for begin, end, step, body in ((_count(0), full, LANES, whole), (full, n, 1, single)):
        with cgutils.for_range_slice(builder, begin, end, _count(step), intp=_I64) as (i, _):
            body(i)


@intrinsic
def add_scaled(typing_context: Any, n: Any, a: Any, x: Any, y: Any) -> Any:
    """y[:n] += a x[:n]."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, a = given[0], given[1]
        x, y = _pointer(builder, given[2]), _pointer(builder, given[3])
        wide = _broadcast(builder, a)

        def whole(i: Any) -> None:
            _store(builder, _multiply_add(builder, wide, _load(builder, x, i), _load(builder, y, i)), y, i)

        def single(i: Any) -> None:
            at = builder.gep(y, [i])
            builder.store(_multiply_add(builder, a, builder.load(builder.gep(x, [i])), builder.load(at)), at)

        _in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _f64, _i64, _i64), codegen


@intrinsic
def rotate(typing_context: Any, n: Any, c: Any, s: Any, x: Any, y: Any) -> Any:
    """x[:n], y[:n] = c x - s y, s x + c y."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, c, s = given[:3]
        x, y = _pointer(builder, given[3]), _pointer(builder, given[4])
        wide_c, wide_s = _broadcast(builder, c), _broadcast(builder, s)

        def turned(c: Any, s: Any, a: Any, b: Any) -> tuple[Any, Any]:
            left = _multiply_add(builder, c, a, builder.fneg(builder.fmul(s, b)))
            return left, _multiply_add(builder, s, a, builder.fmul(c, b))

        def whole(i: Any) -> None:
            left, right = turned(wide_c, wide_s, _load(builder, x, i), _load(builder, y, i))
            _store(builder, left, x, i)
            _store(builder, right, y, i)

        def single(i: Any) -> None:
            at_x, at_y = builder.gep(x, [i]), builder.gep(y, [i])
            left, right = turned(c, s, builder.load(at_x), builder.load(at_y))
            builder.store(left, at_x)
            builder.store(right, at_y)

        _in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _f64, _f64, _i64, _i64), codegen
