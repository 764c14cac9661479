"""Vector instructions, spelled out, for the loops in which filters of large states and ensembles spend their time.

Numba's own vectoriser is off (see `jit.py`: small filters lose by it). Each function here becomes a few instructions
on vectors of 8 numbers, which LLVM splits where the processor's are shorter. An element's sum runs in the same order
wherever its block begins, so results are the same bits in any partition of the columns.

All take addresses (`array.ctypes.data`), which is what makes them free of overhead at a length of 8.
"""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .jit import jit

LANES = 8
"""Numbers in a vector."""


@jit
def padded(n):
    """How wide a row of n numbers is that takes whole vectors."""
    return (n + LANES - 1) // LANES * LANES


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


def _first_lanes(builder: Any, count: Any) -> Any:
    """The mask of a vector's first `count` numbers (all of them where there are more)."""
    lanes = ir.Constant(ir.VectorType(_I64, LANES), list(range(LANES)))
    return builder.icmp_signed("<", lanes, _broadcast(builder, count))


def _load_first(builder: Any, pointer: Any, index: Any, mask: Any) -> Any:
    """A vector of which only the masked numbers are read; the others are 0."""
    at = _at(builder, pointer, index)
    kind = ir.FunctionType(_VECTOR, [at.type, _I32, mask.type, _VECTOR])
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.load.v{LANES}f64.p0v{LANES}f64")
    return builder.call(function, [at, ir.Constant(_I32, 8), mask, ir.Constant(_VECTOR, [0.0] * LANES)])


def _store_first(builder: Any, value: Any, pointer: Any, index: Any, mask: Any) -> None:
    """Write the masked numbers of a vector."""
    at = _at(builder, pointer, index)
    kind = ir.FunctionType(ir.VoidType(), [_VECTOR, at.type, _I32, mask.type])
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.store.v{LANES}f64.p0v{LANES}f64")
    builder.call(function, [value, at, ir.Constant(_I32, 8), mask])


def _broadcast(builder: Any, value: Any) -> Any:
    undefined = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
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
def combine(typing_context: Any, count: Any, weights: Any, apart: Any, x: Any, stride: Any, n: Any, out: Any) -> Any:
    """out[:n] = Σ_k weights[k·apart] x[k·stride :][:n], k < count."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        count, apart, stride, n = given[0], given[2], given[4], given[5]
        w, x, out = (_pointer(builder, given[k]) for k in (1, 3, 6))

        def summed(i: Any, zero: Any, load: Any, spread: Any) -> Any:
            sums = cgutils.alloca_once(builder, zero.type)
            builder.store(zero, sums)
            with cgutils.for_range(builder, count) as loop:
                weight = builder.load(builder.gep(w, [builder.mul(loop.index, apart)]))
                row = builder.gep(x, [builder.mul(loop.index, stride)])
                builder.store(_multiply_add(builder, spread(weight), load(row), builder.load(sums)), sums)
            return builder.load(sums)

        def whole(i: Any) -> None:
            zero = ir.Constant(_VECTOR, [0.0] * LANES)
            added = summed(i, zero, lambda row: _load(builder, row, i), lambda weight: _broadcast(builder, weight))
            _store(builder, added, out, i)

        def single(i: Any) -> None:
            zero = ir.Constant(_F64, 0.0)
            added = summed(i, zero, lambda row: builder.load(builder.gep(row, [i])), lambda weight: weight)
            builder.store(added, builder.gep(out, [i]))

        _in_vectors(builder, n, whole, single)
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
        w, x, out = (_pointer(builder, given[k]) for k in (1, 3, 6))

        def summed(kind: Any, load: Any, spread: Any, store: Any) -> None:
            sums = [cgutils.alloca_once(builder, kind) for _ in range(4)]
            for one in sums:
                builder.store(ir.Constant(kind, [0.0] * LANES if isinstance(kind, ir.VectorType) else 0.0), one)
            with cgutils.for_range(builder, count) as loop:
                weight = builder.gep(w, [builder.mul(loop.index, apart)])
                value = load(builder.gep(x, [builder.mul(loop.index, stride)]))
                for i, one in enumerate(sums):
                    own = spread(builder.load(builder.gep(weight, [_count(i)])))
                    builder.store(_multiply_add(builder, own, value, builder.load(one)), one)
            for i, one in enumerate(sums):
                store(builder.load(one), builder.gep(out, [builder.mul(width, _count(i))]))

        def whole(at: Any) -> None:
            summed(
                _VECTOR,
                lambda row: _load(builder, row, at),
                lambda weight: _broadcast(builder, weight),
                lambda value, row: _store(builder, value, row, at),
            )

        def single(at: Any) -> None:
            summed(
                _F64,
                lambda row: builder.load(builder.gep(row, [at])),
                lambda weight: weight,
                lambda value, row: builder.store(value, builder.gep(row, [at])),
            )

        _in_vectors(builder, n, whole, single)
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
        left, x, right, y, z = (_pointer(builder, given[k]) for k in (3, 4, 5, 6, 7))

        def added(own_x: Any, own_y: Any, load: Any, spread: Any, store: Any) -> None:
            own_x, own_y = builder.fmul(spread(a), own_x), builder.fmul(spread(a), own_y)
            with cgutils.for_range(builder, rows) as loop:
                row = builder.gep(z, [builder.mul(loop.index, stride)])
                one, other = (spread(builder.load(builder.gep(side, [loop.index]))) for side in (left, right))
                first = _multiply_add(builder, one, own_x, load(row))
                store(_multiply_add(builder, other, own_y, first), row)

        def whole(i: Any) -> None:
            added(
                _load(builder, x, i),
                _load(builder, y, i),
                lambda row: _load(builder, row, i),
                lambda number: _broadcast(builder, number),
                lambda value, row: _store(builder, value, row, i),
            )

        def single(i: Any) -> None:
            added(
                builder.load(builder.gep(x, [i])),
                builder.load(builder.gep(y, [i])),
                lambda row: builder.load(builder.gep(row, [i])),
                lambda number: number,
                lambda value, row: builder.store(value, builder.gep(row, [i])),
            )

        _in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _f64, _i64, _i64, _i64, _i64, _i64, _i64), codegen


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


def _sum_of(builder: Any, vector: Any) -> Any:
    """The numbers of a vector, added in pairs."""
    numbers = [builder.extract_element(vector, ir.Constant(_I32, k)) for k in range(LANES)]
    while len(numbers) > 1:
        numbers = [builder.fadd(a, b) for a, b in zip(numbers[::2], numbers[1::2], strict=True)]
    return numbers[0]


def _summing(builder: Any, n: Any, whole: Any, single: Any) -> Any:
    """Σ over n numbers, by vectors: total = whole(i, total) for the full ones, then single(i, sum) for the rest."""
    wide, narrow = cgutils.alloca_once(builder, _VECTOR), cgutils.alloca_once(builder, _F64)
    builder.store(ir.Constant(_VECTOR, [0.0] * LANES), wide)
    builder.store(ir.Constant(_F64, 0.0), narrow)
    _in_vectors(
        builder,
        n,
        lambda i: builder.store(whole(i, builder.load(wide)), wide),
        lambda i: builder.store(single(i, builder.load(narrow)), narrow),
    )
    return builder.fadd(_sum_of(builder, builder.load(wide)), builder.load(narrow))


@intrinsic
def total(typing_context: Any, n: Any, x: Any) -> Any:
    """Σ x[:n]."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        x = _pointer(builder, given[1])
        return _summing(
            builder,
            given[0],
            lambda i, sums: builder.fadd(sums, _load(builder, x, i)),
            lambda i, sums: builder.fadd(sums, builder.load(builder.gep(x, [i]))),
        )

    return _f64(_i64, _i64), codegen


@intrinsic
def dot(typing_context: Any, n: Any, a: Any, b: Any) -> Any:
    """Σ a[:n] b[:n]."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        a, b = _pointer(builder, given[1]), _pointer(builder, given[2])
        return _summing(
            builder,
            given[0],
            lambda i, total: _multiply_add(builder, _load(builder, a, i), _load(builder, b, i), total),
            lambda i, total: _multiply_add(
                builder, builder.load(builder.gep(a, [i])), builder.load(builder.gep(b, [i])), total
            ),
        )

    return _f64(_i64, _i64, _i64), codegen


@intrinsic
def weighted(typing_context: Any, n: Any, w: Any, x: Any, out: Any) -> Any:
    """out[:n] = w[:n] x[:n]; returns Σ out[:n]."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        w, x, out = (_pointer(builder, given[k]) for k in (1, 2, 3))

        def whole(i: Any, total: Any) -> Any:
            value = builder.fmul(_load(builder, w, i), _load(builder, x, i))
            _store(builder, value, out, i)
            return builder.fadd(total, value)

        def single(i: Any, total: Any) -> Any:
            value = builder.fmul(builder.load(builder.gep(w, [i])), builder.load(builder.gep(x, [i])))
            builder.store(value, builder.gep(out, [i]))
            return builder.fadd(total, value)

        return _summing(builder, given[0], whole, single)

    return _f64(_i64, _i64, _i64, _i64), codegen


@intrinsic
def resolve(
    typing_context: Any,
    n: Any,
    d: Any,
    e: Any,
    b: Any,
    blocks: Any,
    shifts: Any,
    weights: Any,
    scratch: Any,
    out: Any,
) -> Any:
    """out[:n] = Σ_k weights[k] (T + shifts[k] I)⁻¹ b, T tridiagonal with diagonal d[:n], and e[1:n] beside it.

    By elimination without exchanges, which is stable where all T + shifts[k] I are positive definite; `LANES` shifts at
    a time, which is what `blocks` counts. e[0] must be 0. `scratch` holds (3 n + 1) LANES numbers.
    """

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, blocks = given[0], given[4]
        d, e, b, shifts, weights, factors, out = (_pointer(builder, given[k]) for k in (1, 2, 3, 5, 6, 7, 8))
        lanes = _count(LANES)
        values = builder.gep(factors, [builder.mul(builder.add(n, _count(1)), lanes)])
        sums = builder.gep(values, [builder.mul(n, lanes)])
        nothing, one = (ir.Constant(_VECTOR, [number] * LANES) for number in (0.0, 1.0))
        inverse, y = cgutils.alloca_once(builder, _VECTOR), cgutils.alloca_once(builder, _VECTOR)

        def entry(pointer: Any, i: Any) -> Any:
            return _broadcast(builder, builder.load(builder.gep(pointer, [i])))

        with cgutils.for_range(builder, n) as loop:
            _store(builder, nothing, sums, builder.mul(loop.index, lanes))
        _store(builder, nothing, factors, builder.mul(n, lanes))
        with cgutils.for_range(builder, blocks) as block:
            at = builder.mul(block.index, lanes)
            shift, weight = _load(builder, shifts, at), _load(builder, weights, at)
            builder.store(nothing, inverse)
            builder.store(nothing, y)
            with cgutils.for_range(builder, n) as loop:
                i, to = loop.index, builder.mul(loop.index, lanes)
                beside = entry(e, i)
                factor = builder.fmul(beside, builder.load(inverse))
                minus = builder.fneg(factor)
                pivot = _multiply_add(builder, minus, beside, builder.fadd(entry(d, i), shift))
                value = _multiply_add(builder, minus, builder.load(y), builder.fmul(weight, entry(b, i)))
                inverted = builder.fdiv(one, pivot)
                builder.store(inverted, inverse)
                builder.store(value, y)
                _store(builder, factor, factors, to)
                _store(builder, builder.fmul(value, inverted), values, to)
            builder.store(nothing, y)
            with cgutils.for_range(builder, n) as loop:
                to = builder.mul(builder.sub(builder.sub(n, _count(1)), loop.index), lanes)
                factor = builder.fneg(_load(builder, factors, builder.add(to, lanes)))
                x = _multiply_add(builder, factor, builder.load(y), _load(builder, values, to))
                builder.store(x, y)
                _store(builder, builder.fadd(_load(builder, sums, to), x), sums, to)
        with cgutils.for_range(builder, n) as loop:
            total = _sum_of(builder, _load(builder, sums, builder.mul(loop.index, lanes)))
            builder.store(total, builder.gep(out, [loop.index]))
        return context.get_dummy_value()

    return types.void(_i64, _i64, _i64, _i64, _i64, _i64, _i64, _i64, _i64), codegen


_LOWEST = -708.0
"""e to this is the smallest normal number, nearly; below it `exp_minus` gives 0."""

_HIGHEST = 709.0

_LN2_HIGH, _LN2_LOW = float.fromhex("0x1.62e42fefa3800p-1"), float.fromhex("0x1.ef35793c76730p-45")
"""ln 2 in two parts; the first has 42 bits, so that its product with an exponent is exact (as in FDLIBM's e_exp.c)."""

_ROUND = 1.5 * 2.0**52
"""Adding and taking it away rounds to a whole number, which then stands in the low bits."""


def _exp(builder: Any, x: Any) -> Any:
    """e^x for a number or a vector of them, within a unit in the last place; 0 below `_LOWEST`.

    x = k ln 2 + r with |r| ≤ ln 2 / 2, and the Taylor polynomial of degree 13, whose remainder is under 5e-18.
    """
    kind = x.type
    wide = isinstance(kind, ir.VectorType)
    whole_kind = ir.VectorType(_I64, LANES) if wide else _I64

    def number(value: float) -> Any:
        return ir.Constant(kind, [value] * LANES if wide else value)

    def whole_number(value: int) -> Any:
        return ir.Constant(whole_kind, [value] * LANES if wide else value)

    low = builder.fcmp_ordered("<", x, number(_LOWEST))
    high = builder.fcmp_ordered(">", x, number(_HIGHEST))
    bounded = builder.select(low, number(_LOWEST), builder.select(high, number(_HIGHEST), x))
    shifted = _multiply_add(builder, bounded, number(1.4426950408889634), number(_ROUND))
    k = builder.fsub(shifted, number(_ROUND))
    r = _multiply_add(builder, k, number(-_LN2_HIGH), bounded)
    r = _multiply_add(builder, k, number(-_LN2_LOW), r)
    value = number(1.0 / math.factorial(13))
    for power in range(12, -1, -1):
        value = _multiply_add(builder, value, r, number(1.0 / math.factorial(power)))
    exponent = builder.add(builder.bitcast(shifted, whole_kind), whole_number(1023))
    power_of_two = builder.bitcast(builder.shl(exponent, whole_number(52)), kind)
    value = builder.fmul(value, power_of_two)
    value = builder.select(low, number(0.0), value)
    return builder.select(high, number(math.inf), value)


@intrinsic
def exp_minus(typing_context: Any, n: Any, x: Any, shift: Any, out: Any) -> Any:
    """out[:n] = e^(x[:n] - shift), within a unit in the last place; 0 where it is below the normal numbers."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, shift = given[0], given[2]
        x, out = _pointer(builder, given[1]), _pointer(builder, given[3])
        wide = _broadcast(builder, shift)

        def whole(i: Any) -> None:
            _store(builder, _exp(builder, builder.fsub(_load(builder, x, i), wide)), out, i)

        def single(i: Any) -> None:
            value = _exp(builder, builder.fsub(builder.load(builder.gep(x, [i])), shift))
            builder.store(value, builder.gep(out, [i]))

        _in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _f64, _i64), codegen


@intrinsic
def centre(typing_context: Any, rows: Any, k: Any, width: Any, x: Any, w: Any, mean: Any) -> Any:
    """Rows of k numbers, `width` apart (whole vectors), become deviations from mean = x₀ + w Σ_r (x_r - x₀).

    What stands behind the k numbers becomes zero: left alone, it would shrink from call to call to subnormal numbers,
    which take a hundred times as long.
    """

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        rows, k, width = given[:3]
        x, mean = _pointer(builder, given[3]), _pointer(builder, given[5])
        weight = _broadcast(builder, given[4])
        nothing = ir.Constant(_VECTOR, [0.0] * LANES)
        lanes = ir.Constant(ir.VectorType(_I64, LANES), list(range(LANES)))
        sums = cgutils.alloca_once(builder, _VECTOR)

        def others(body: Any) -> None:
            with cgutils.for_range_slice(builder, _count(1), rows, _count(1), intp=_I64) as (r, _):
                body(builder.gep(x, [builder.mul(r, width)]))

        with cgutils.for_range_slice(builder, _count(0), width, _count(LANES), intp=_I64) as (at, _):
            own = builder.icmp_signed("<", lanes, _broadcast(builder, builder.sub(k, at)))

            def load(row: Any) -> Any:
                return builder.select(own, _load(builder, row, at), nothing)

            central = load(x)
            builder.store(nothing, sums)

            def add(row: Any) -> None:
                builder.store(builder.fadd(builder.load(sums), builder.fsub(load(row), central)), sums)

            others(add)
            shift = builder.fmul(weight, builder.load(sums))
            _store(builder, builder.fadd(central, shift), mean, at)

            def deviate(row: Any) -> None:
                _store(builder, builder.fsub(builder.fsub(load(row), central), shift), row, at)

            others(deviate)
            _store(builder, builder.fsub(nothing, shift), x, at)
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
        a, b, out = (_pointer(builder, given[k]) for k in (2, 4, 8))
        first, weight = _broadcast(builder, given[6]), _broadcast(builder, given[7])
        sums = [cgutils.alloca_once(builder, _VECTOR) for _ in range(4)]

        def entries(row: Any, i: Any, count: int) -> list[Any]:
            return [
                _broadcast(builder, builder.load(builder.gep(row, [builder.add(i, _count(k))]))) for k in range(count)
            ]

        def tile(i: Any, at: Any, count: int) -> None:
            """Rows i, …, i + count - 1 of one vector's columns."""
            mine = sums[:count]
            for one in mine:
                builder.store(ir.Constant(_VECTOR, [0.0] * LANES), one)
            with cgutils.for_range_slice(builder, _count(1), rows, _count(1), intp=_I64) as (r, _):
                row = _load(builder, builder.gep(b, [builder.mul(r, b_width)]), at)
                own = entries(builder.gep(a, [builder.mul(r, a_width)]), i, count)
                for one, entry in zip(mine, own, strict=True):
                    builder.store(_multiply_add(builder, entry, row, builder.load(one)), one)
            zeroth = builder.fmul(first, _load(builder, b, at))
            mask = _first_lanes(builder, builder.sub(columns, at))
            for k, (one, entry) in enumerate(zip(mine, entries(a, i, count), strict=True)):
                whole = builder.fadd(builder.fmul(weight, builder.load(one)), builder.fmul(entry, zeroth))
                to = builder.gep(out, [builder.mul(builder.add(i, _count(k)), columns)])
                _store_first(builder, whole, to, at, mask)

        begin = _count(0)
        for count in (4, 2, 1):
            end = builder.and_(n, _count(-count))
            with cgutils.for_range_slice(builder, begin, end, _count(count), intp=_I64) as (i, _):
                with cgutils.for_range_slice(builder, _count(0), b_width, _count(LANES), intp=_I64) as (at, _):
                    tile(i, at, count)
            begin = end
        return context.get_dummy_value()

    return types.void(_i64, _i64, _i64, _i64, _i64, _i64, _f64, _f64, _i64, _i64), codegen


@intrinsic
def subtract_squares(typing_context: Any, n: Any, rows: Any, w: Any, width: Any, p: Any) -> Any:
    """P (n, n) -= Σ_k w_kᵀ w_k over rows w_k, `width` apart (whole vectors); what is symmetric stays so, bit by bit."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, rows, width = given[0], given[1], given[3]
        w, p = _pointer(builder, given[2]), _pointer(builder, given[4])
        left = cgutils.alloca_once(builder, _VECTOR)
        with cgutils.for_range_slice(builder, _count(0), width, _count(LANES), intp=_I64) as (at, _):
            own = _first_lanes(builder, builder.sub(n, at))
            with cgutils.for_range(builder, n) as loop:
                to = builder.gep(p, [builder.mul(loop.index, n)])
                builder.store(_load_first(builder, to, at, own), left)
                with cgutils.for_range(builder, rows) as inner:
                    row = builder.gep(w, [builder.mul(inner.index, width)])
                    factor = _broadcast(builder, builder.fneg(builder.load(builder.gep(row, [loop.index]))))
                    builder.store(_multiply_add(builder, factor, _load(builder, row, at), builder.load(left)), left)
                _store_first(builder, builder.load(left), to, at, own)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _i64, _i64, _i64), codegen


@intrinsic
def factor_rows(typing_context: Any, n: Any, a: Any, u: Any, width: Any) -> Any:
    """Upper U with Uᵀ U = A (n, n), its rows `width` apart (whole vectors): 1, or 0 if A is not positive definite.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., algorithm 4.2.2 (outer product form).
    """

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, width = given[0], given[3]
        a, u = (_pointer(builder, given[k]) for k in (1, 2))
        good = cgutils.alloca_once(builder, _I64)
        builder.store(_count(1), good)
        one, nothing = ir.Constant(_F64, 1.0), ir.Constant(_VECTOR, [0.0] * LANES)
        root = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_F64, [_F64]), "llvm.sqrt.f64")

        def columns(first: Any) -> Any:
            return cgutils.for_range_slice(builder, first, width, _count(LANES), intp=_I64)

        with cgutils.for_range(builder, n) as loop, columns(_count(0)) as (at, _):
            row = builder.gep(a, [builder.mul(loop.index, n)])
            value = _load_first(builder, row, at, _first_lanes(builder, builder.sub(n, at)))
            _store(builder, value, builder.gep(u, [builder.mul(loop.index, width)]), at)
        with cgutils.for_range(builder, n) as loop:
            k = loop.index
            row = builder.gep(u, [builder.mul(k, width)])
            pivot = builder.load(builder.gep(row, [k]))
            positive = builder.fcmp_ordered(">", pivot, ir.Constant(_F64, 0.0))
            finite = builder.fcmp_ordered("<", pivot, ir.Constant(_F64, math.inf))
            both = builder.zext(builder.and_(positive, finite), _I64)
            builder.store(builder.and_(builder.load(good), both), good)
            # The next pivot waits for a division only; the root is off its way.
            inverse = builder.fneg(builder.fdiv(one, pivot))
            scale = _broadcast(builder, builder.fdiv(one, builder.call(root, [pivot])))
            begin = builder.and_(k, _count(-LANES))
            with cgutils.for_range_slice(builder, builder.add(k, _count(1)), n, _count(1), intp=_I64) as (i, _):
                factor = _broadcast(builder, builder.fmul(builder.load(builder.gep(row, [i])), inverse))
                other = builder.gep(u, [builder.mul(i, width)])
                with columns(begin) as (at, _):
                    value = _multiply_add(builder, factor, _load(builder, row, at), _load(builder, other, at))
                    _store(builder, value, other, at)
            with columns(_count(0)) as (at, _):
                # What elimination left of zeros is cleared.
                left = _first_lanes(builder, builder.sub(k, at))
                _store(builder, builder.select(left, nothing, builder.fmul(scale, _load(builder, row, at))), row, at)
        return builder.load(good)

    return _i64(_i64, _i64, _i64, _i64), codegen


@intrinsic
def around(typing_context: Any, n: Any, x: Any, u: Any, apart: Any, spread: Any, points: Any, width: Any) -> Any:
    """points (2n + 1, width) = x, x + spread u_k, x - spread u_k with rows u_k (n,) that are `apart`."""

    def codegen(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        n, apart, width = given[0], given[3], given[6]
        x, u, points = (_pointer(builder, given[k]) for k in (1, 2, 5))
        spread = _broadcast(builder, given[4])
        half = builder.mul(n, width)
        with cgutils.for_range_slice(builder, _count(0), width, _count(LANES), intp=_I64) as (at, _):
            own = _first_lanes(builder, builder.sub(n, at))
            centre = _load_first(builder, x, at, own)
            _store(builder, centre, points, at)
            with cgutils.for_range(builder, n) as loop:
                row = builder.gep(u, [builder.mul(loop.index, apart)])
                d = builder.fmul(spread, _load_first(builder, row, at, own))
                to = builder.add(builder.mul(builder.add(loop.index, _count(1)), width), at)
                _store(builder, builder.fadd(centre, d), points, to)
                _store(builder, builder.fsub(centre, d), points, builder.add(to, half))
        return context.get_dummy_value()

    return types.void(_i64, _i64, _i64, _i64, _f64, _i64, _i64), codegen
