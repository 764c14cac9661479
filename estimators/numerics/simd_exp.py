"""The exponential function of many numbers, in simd_ir."""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from . import simd_ir
from .simd_ir import LANES

_i64, _f64 = types.int64, types.float64


_LOWEST = -708.0
"""e to this is the smallest normal number, nearly; below it `exp_minus` gives 0."""

_HIGHEST = 709.0

_LN2_HIGH, _LN2_LOW = float.fromhex("0x1.62e42fefa3800p-1"), float.fromhex("0x1.ef35793c76730p-45")
"""ln 2 in two parts; the first has 42 bits, so that its product with an exponent is exact (as in FDLIBM's e_exp.c)."""

_ROUND = 1.5 * 2.0**52
"""Adding and taking it away rounds to a whole number, which then stands in the low bits."""


def exponential(builder: Any, x: Any) -> Any:
    """e^x for a number or a vector of them, within a unit in the last place; 0 below `_LOWEST`.

    x = k ln 2 + r with |r| ≤ ln 2 / 2, and the Taylor polynomial of degree 13, whose remainder is under 5e-18.
    """
    kind = x.type
    wide = isinstance(kind, ir.VectorType)
    whole_kind = ir.VectorType(simd_ir.I64, LANES) if wide else simd_ir.I64

    def number(value: float) -> Any:
        return ir.Constant(kind, [value] * LANES if wide else value)

    def whole_number(value: int) -> Any:
        return ir.Constant(whole_kind, [value] * LANES if wide else value)

    low = builder.fcmp_ordered("<", x, number(_LOWEST))
    high = builder.fcmp_ordered(">", x, number(_HIGHEST))
    bounded = builder.select(low, number(_LOWEST), builder.select(high, number(_HIGHEST), x))
    shifted = simd_ir.multiply_add(builder, bounded, number(1.4426950408889634), number(_ROUND))
    k = builder.fsub(shifted, number(_ROUND))
    r = simd_ir.multiply_add(builder, k, number(-_LN2_HIGH), bounded)
    r = simd_ir.multiply_add(builder, k, number(-_LN2_LOW), r)
    value = number(1.0 / math.factorial(13))
    for power in range(12, -1, -1):
        value = simd_ir.multiply_add(builder, value, r, number(1.0 / math.factorial(power)))
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
        x, out = simd_ir.pointer(builder, given[1]), simd_ir.pointer(builder, given[3])
        wide = simd_ir.broadcast(builder, shift)

        def whole(i: Any) -> None:
            simd_ir.store(builder, exponential(builder, builder.fsub(simd_ir.load(builder, x, i), wide)), out, i)

        def single(i: Any) -> None:
            value = exponential(builder, builder.fsub(builder.load(builder.gep(x, [i])), shift))
            builder.store(value, builder.gep(out, [i]))

        simd_ir.in_vectors(builder, n, whole, single)
        return context.get_dummy_value()

    return types.void(_i64, _i64, _f64, _i64), codegen
