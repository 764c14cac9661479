"""Building blocks of vector code: LLVM instructions on vectors of `LANES` numbers, for simd.py and its like.

The compiler splits them where the processor's vectors are shorter.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba.core import cgutils

from .jit import jit

LANES = 8
"""Numbers in a vector."""

I32, I64, F64 = ir.IntType(32), ir.IntType(64), ir.DoubleType()
VECTOR = ir.VectorType(F64, LANES)
ZERO = ir.Constant(VECTOR, [0.0] * LANES)


@jit
def padded(n):
    """How wide a row of n numbers is that takes whole vectors."""
    return (n + LANES - 1) // LANES * LANES


def constant(number: int) -> Any:
    """A whole number."""
    return ir.Constant(I64, number)


def pointer(builder: Any, address: Any) -> Any:
    """The numbers that begin at an address."""
    return builder.inttoptr(address, F64.as_pointer())


def at(builder: Any, base: Any, index: Any) -> Any:
    """The address of the vector that begins at base[index]; it need not be aligned to more than a number."""
    return builder.bitcast(builder.gep(base, [index]), VECTOR.as_pointer())


def load(builder: Any, base: Any, index: Any) -> Any:
    """The vector that begins at base[index]."""
    return builder.load(at(builder, base, index), align=8)


def store(builder: Any, value: Any, base: Any, index: Any) -> None:
    """Write a vector to base[index] and behind."""
    builder.store(value, at(builder, base, index), align=8)


def first(builder: Any, count: Any) -> Any:
    """The mask of a vector's first `count` numbers (all of them where there are more)."""
    lanes = ir.Constant(ir.VectorType(I64, LANES), list(range(LANES)))
    return builder.icmp_signed("<", lanes, broadcast(builder, count))


def load_first(builder: Any, base: Any, index: Any, mask: Any) -> Any:
    """A vector of which only the masked numbers are read; the others are 0."""
    place = at(builder, base, index)
    kind = ir.FunctionType(VECTOR, [place.type, I32, mask.type, VECTOR])
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.load.v{LANES}f64.p0v{LANES}f64")
    return builder.call(function, [place, ir.Constant(I32, 8), mask, ZERO])


def store_first(builder: Any, value: Any, base: Any, index: Any, mask: Any) -> None:
    """Write the masked numbers of a vector."""
    place = at(builder, base, index)
    kind = ir.FunctionType(ir.VoidType(), [VECTOR, place.type, I32, mask.type])
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.store.v{LANES}f64.p0v{LANES}f64")
    builder.call(function, [value, place, ir.Constant(I32, 8), mask])


def broadcast(builder: Any, value: Any) -> Any:
    """A vector of one number."""
    undefined = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(I32, 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(I32, LANES), [0] * LANES))


def multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c, of numbers or of vectors."""
    kind = c.type
    name = "llvm.fmuladd.f64" if kind == F64 else f"llvm.fmuladd.v{LANES}f64"
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind] * 3), name)
    return builder.call(function, [a, b, c])


@contextmanager
def steps(builder: Any, begin: Any, end: Any, step: int = 1) -> Iterator[Any]:
    """A loop from `begin` up to `end`, which it does not reach."""
    first = constant(begin) if isinstance(begin, int) else begin
    with cgutils.for_range_slice(builder, first, end, constant(step), intp=I64) as (index, _):
        yield index


def in_vectors(builder: Any, n: Any, whole: Any, single: Any) -> None:
    """whole(i) for each full vector of n numbers, then single(i) for each number of the rest."""
    full = builder.and_(n, constant(-LANES))
    for begin, end, step, body in ((constant(0), full, LANES, whole), (full, n, 1, single)):
        with steps(builder, begin, end, step) as i:
            body(i)


def sum_of(builder: Any, vector: Any) -> Any:
    """The numbers of a vector, added in pairs."""
    numbers = [builder.extract_element(vector, ir.Constant(I32, k)) for k in range(LANES)]
    while len(numbers) > 1:
        numbers = [builder.fadd(a, b) for a, b in zip(numbers[::2], numbers[1::2], strict=True)]
    return numbers[0]


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
    whole_kind = ir.VectorType(I64, LANES) if wide else I64

    def number(value: float) -> Any:
        return ir.Constant(kind, [value] * LANES if wide else value)

    def whole_number(value: int) -> Any:
        return ir.Constant(whole_kind, [value] * LANES if wide else value)

    low = builder.fcmp_ordered("<", x, number(_LOWEST))
    high = builder.fcmp_ordered(">", x, number(_HIGHEST))
    bounded = builder.select(low, number(_LOWEST), builder.select(high, number(_HIGHEST), x))
    shifted = multiply_add(builder, bounded, number(1.4426950408889634), number(_ROUND))
    k = builder.fsub(shifted, number(_ROUND))
    r = multiply_add(builder, k, number(-_LN2_HIGH), bounded)
    r = multiply_add(builder, k, number(-_LN2_LOW), r)
    value = number(1.0 / math.factorial(13))
    for power in range(12, -1, -1):
        value = multiply_add(builder, value, r, number(1.0 / math.factorial(power)))
    exponent = builder.add(builder.bitcast(shifted, whole_kind), whole_number(1023))
    power_of_two = builder.bitcast(builder.shl(exponent, whole_number(52)), kind)
    value = builder.fmul(value, power_of_two)
    value = builder.select(low, number(0.0), value)
    return builder.select(high, number(math.inf), value)
