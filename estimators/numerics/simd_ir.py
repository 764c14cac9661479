"""Building blocks of vector code: LLVM instructions on vectors of `LANES` numbers, for simd.py and its like.

Numba's own vectoriser is off, as small filters lose by it (see jit.py). The compiler splits vectors where the
processor's are shorter.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from llvmlite import ir
from llvmlite.ir import Value
from numba import types
from numba.core import cgutils
from numba.core.cgutils import _StructProxy as Array
from numba.extending import intrinsic

from .jit import BaseContext, IRBuilder, Signature, jit

LANES = 8
"""Numbers in a vector."""

I32, I64, F64 = ir.IntType(32), ir.IntType(64), ir.DoubleType()
VECTOR = ir.VectorType(F64, LANES)


@jit
def padded(n):
    """Return the length of a row of n numbers rounded up to whole vectors."""
    return (n + LANES - 1) // LANES * LANES


def vector_code(result: types.Type = types.void) -> Callable[[Callable], Callable]:
    """Decorator: make a function for compiled code out of one that writes its instructions.

    The decorated function gets `Lanes` and the arguments: of a contiguous float64 array an object with `data`, the
    pointer to its first number, and `shape`; of other numbers an int64 or a float64. `n` counts the numbers of a row
    that are worked on. It returns the value of `result`, or None.
    """

    def decorate(write: Callable) -> Callable:
        def typed(typing_context: object, *given: types.Type) -> tuple[Signature, Callable]:
            arguments = [
                t if isinstance(t, types.Array) else types.float64 if isinstance(t, types.Float) else types.int64
                for t in given
            ]

            def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, values: list[Value]) -> Value:
                arrays = [
                    context.make_array(t)(context, builder, value) if isinstance(t, types.Array) else value
                    for t, value in zip(signature.args, values, strict=True)
                ]
                made = write(Lanes(builder), *arrays)
                return context.get_dummy_value() if made is None else made

            return result(*arguments), codegen

        typed.__name__, typed.__doc__, typed.__module__ = write.__name__, write.__doc__, write.__module__
        # Numba binds arguments by this signature, whose first parameter is the typing context.
        typed.__signature__ = inspect.signature(write)  # type: ignore[attr-defined]
        return intrinsic(typed)

    return decorate


def integer(number: int) -> Value:
    """Return an int64 constant."""
    return ir.Constant(I64, number)


def sizes(builder: IRBuilder, array: Array) -> list[Value]:
    """Return the shape of an array."""
    return cgutils.unpack_tuple(builder, array.shape)  # type: ignore[no-any-return]


class Lanes:
    """Instructions on vectors of `LANES` numbers, or on single numbers for the rest of a row."""

    def __init__(self, builder: IRBuilder, wide: bool = True) -> None:
        self.builder, self.wide = builder, wide
        self.kind = VECTOR if wide else F64

    def constant(self, value: float) -> Value:
        """Return a vector of one number, float64s of a float and int64s of an int."""
        element = F64 if isinstance(value, float) else I64
        return ir.Constant(ir.VectorType(element, LANES), [value] * LANES) if self.wide else ir.Constant(element, value)

    def spread(self, value: Value) -> Value:
        """Return a vector of one value."""
        if not self.wide:
            return value
        undefined = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
        one = self.builder.insert_element(undefined, value, ir.Constant(I32, 0))
        return self.builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(I32, LANES), [0] * LANES))

    def entry(self, base: Value, index: Value) -> Value:
        """Return a vector of the number base[index]."""
        return self.spread(self.builder.load(self.builder.gep(base, [index])))

    def variable(self, value: Value | None = None) -> Value:
        """Return memory for a vector, set to `value` or zero here, so in a loop each time."""
        place = cgutils.alloca_once(self.builder, self.kind)
        self.builder.store(self.constant(0.0) if value is None else value, place)
        return place

    def _place(self, base: Value, index: Value) -> Value:
        place = self.builder.gep(base, [index])
        return self.builder.bitcast(place, VECTOR.as_pointer()) if self.wide else place

    def load(self, base: Value, index: Value) -> Value:
        """Return the vector that begins at base[index], which need not be aligned to more than a number."""
        return self.builder.load(self._place(base, index), align=8)

    def store(self, value: Value, base: Value, index: Value) -> None:
        """Write a vector to base[index] and the following numbers."""
        self.builder.store(value, self._place(base, index), align=8)

    def add_to(self, variable: Value, value: Value) -> None:
        """Add a vector to a `variable`."""
        self.builder.store(self.builder.fadd(self.builder.load(variable), value), variable)

    def multiply_add_to(self, variable: Value, a: Value, b: Value) -> None:
        """Add a b to a `variable`."""
        self.builder.store(self.multiply_add(a, b, self.builder.load(variable)), variable)

    def multiply_add(self, a: Value, b: Value, c: Value) -> Value:
        """Return a b + c."""
        name = f"llvm.fmuladd.v{LANES}f64" if self.wide else "llvm.fmuladd.f64"
        kind = ir.FunctionType(self.kind, [self.kind] * 3)
        return self.builder.call(cgutils.get_or_insert_function(self.builder.module, kind, name), [a, b, c])

    def unary(self, name: str, x: Value) -> Value:
        """Return LLVM's function of one number, such as sqrt or fabs, of each number of a vector."""
        name = f"llvm.{name}.v{LANES}f64" if self.wide else f"llvm.{name}.f64"
        kind = ir.FunctionType(self.kind, [self.kind])
        return self.builder.call(cgutils.get_or_insert_function(self.builder.module, kind, name), [x])

    def first(self, count: Value) -> Value:
        """Return the mask of a vector's first `count` numbers (all of them where there are more)."""
        lanes = ir.Constant(ir.VectorType(I64, LANES), list(range(LANES)))
        return self.builder.icmp_signed("<", lanes, self.spread(count))

    def load_first(self, base: Value, index: Value, mask: Value) -> Value:
        """Return a vector whose masked numbers are read; the others are 0."""
        return self._masked("load", VECTOR, self._place(base, index), mask, [self.constant(0.0)])

    def store_first(self, value: Value, base: Value, index: Value, mask: Value) -> None:
        """Write the masked numbers of a vector."""
        self._masked("store", ir.VoidType(), self._place(base, index), mask, [], value)

    def _masked(self, name: str, result: ir.Type, place: Value, mask: Value, after: list, *before: Value) -> Value:
        given = [*before, place, ir.Constant(I32, 8), mask, *after]
        kind = ir.FunctionType(result, [item.type for item in given])
        name = f"llvm.masked.{name}.v{LANES}f64.p0v{LANES}f64"
        return self.builder.call(cgutils.get_or_insert_function(self.builder.module, kind, name), given)

    def sum_of(self, vector: Value) -> Value:
        """Return the sum of the numbers of a vector, added in pairs."""
        numbers = [self.builder.extract_element(vector, ir.Constant(I32, k)) for k in range(LANES)]
        while len(numbers) > 1:
            numbers = [self.builder.fadd(a, b) for a, b in zip(numbers[::2], numbers[1::2], strict=True)]
        return numbers[0]


@contextmanager
def steps(builder: IRBuilder, begin: Value | int, end: Value, step: int = 1) -> Iterator[Value]:
    """Context manager: a loop from `begin` up to `end`, which it does not reach."""
    first = integer(begin) if isinstance(begin, int) else begin
    with cgutils.for_range_slice(builder, first, end, integer(step), intp=I64) as (index, _):
        yield index


def in_vectors(v: Lanes, n: Value, body: Callable[[Lanes, Value], None]) -> None:
    """Write body(lanes, i) for each full vector of n numbers, then for each number of the rest."""
    full = v.builder.and_(n, integer(-LANES))
    for begin, end, step in ((integer(0), full, LANES), (full, n, 1)):
        with steps(v.builder, begin, end, step) as i:
            body(Lanes(v.builder, step == LANES), i)


def sum_in_vectors(v: Lanes, n: Value, add: Callable[[Lanes, Value, Value], None]) -> Value:
    """Return a sum over n numbers, in vectors: add(lanes, i, variable) adds to its variable."""
    sums = {wide: Lanes(v.builder, wide).variable() for wide in (True, False)}
    in_vectors(v, n, lambda lanes, i: add(lanes, i, sums[lanes.wide]))
    return v.builder.fadd(v.sum_of(v.builder.load(sums[True])), v.builder.load(sums[False]))


_MIN_EXPONENT = -708.0
"""e to this is nearly the smallest normal number; below it `exp_minus` gives 0."""

_MAX_EXPONENT = 709.0

_LN2_HIGH, _LN2_LOW = float.fromhex("0x1.62e42fefa3800p-1"), float.fromhex("0x1.ef35793c76730p-45")
"""ln 2 in two parts; the first has 42 bits, so that its product with an exponent is exact (as in FDLIBM's e_exp.c)."""

_ROUND = 1.5 * 2.0**52
"""Adding and subtracting it rounds to an integer, which then stands in the low bits."""


def exponential(v: Lanes, x: Value) -> Value:
    """Return e^x within a unit in the last place; 0 below `_MIN_EXPONENT`.

    x = k ln 2 + r with |r| ≤ ln 2 / 2, and the Taylor polynomial of degree 13, whose remainder is under 5e-18.
    """
    builder, number = v.builder, v.constant
    low = builder.fcmp_ordered("<", x, number(_MIN_EXPONENT))
    high = builder.fcmp_ordered(">", x, number(_MAX_EXPONENT))
    bounded = builder.select(low, number(_MIN_EXPONENT), builder.select(high, number(_MAX_EXPONENT), x))
    shifted = v.multiply_add(bounded, number(1.4426950408889634), number(_ROUND))
    k = builder.fsub(shifted, number(_ROUND))
    r = v.multiply_add(k, number(-_LN2_HIGH), bounded)
    r = v.multiply_add(k, number(-_LN2_LOW), r)
    value = number(1.0 / math.factorial(13))
    for power in range(12, -1, -1):
        value = v.multiply_add(value, r, number(1.0 / math.factorial(power)))
    exponent = builder.add(builder.bitcast(shifted, number(0).type), number(1023))
    value = builder.fmul(value, builder.bitcast(builder.shl(exponent, number(52)), v.kind))
    return builder.select(high, number(math.inf), builder.select(low, number(0.0), value))
