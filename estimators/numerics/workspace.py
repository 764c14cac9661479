"""A filter's scratch, laid out once: the views that a kernel works in, and how much room they take.

A filter declares its workspace as the arrays that stand one after the other, with their shapes:

    Work, workspace = declare_layout("Work", "n, m", D="2 * n + 1, m", mean="m")

and a kernel calls it with the address of its scratch, `workspace(start_of(work), n, m)`. The size follows from the same
function, called in Python from address zero without touching memory: `size_of(workspace, n, m)`. A layout can also be
written out as the function that `declare_layout` would make:

    @layout
    def workspace(at, n, m):
        D, at = take_matrix(at, 2 * n + 1, m)
        mean, at = take_vector(at, m)
        return Work(D, mean, at)
"""

from __future__ import annotations

import ast
import sys
from collections import namedtuple
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import carray, types
from numba.extending import intrinsic, overload, register_jitable

from .jit import BaseContext, IRBuilder, Signature, Value, _to_float, _to_int, floats, i64, jit, plain

WORD = 8
"""Bytes of a float64."""

layout = register_jitable
"""Decorator of a layout that stands in others: in Python a plain function, within a kernel compiled."""


class ArrayLayout(NamedTuple):
    """Place of an array in scratch memory, as Python sees it: first byte and shape."""

    at: int
    shape: tuple[int, ...]


def take_matrix(at: int, rows: int, columns: int) -> tuple[Any, int]:
    """A matrix (rows, columns) that begins at the address `at`, and the address after it."""
    return ArrayLayout(at, (rows, columns)), at + WORD * rows * columns


def take_vector(at: int, n: int) -> tuple[Any, int]:
    """A vector (n,) that begins at the address `at`, and the address after it."""
    return ArrayLayout(at, (n,)), at + WORD * n


def take_integers(at: int, n: int) -> tuple[Any, int]:
    """A vector (n,) of int64s that begins at the address `at`, and the address after it."""
    return ArrayLayout(at, (n,)), at + WORD * n


_TAKES = (take_matrix, take_vector, take_integers)


def declare_layout(kind: str, sizes: str, /, *functions: Callable, **fields: str) -> tuple[Any, Callable]:
    """Return a named tuple and the layout `(at, *sizes)` that fills it with arrays that stand one after the other.

    Args:
        kind: Name of the named tuple, to which the caller binds it; its last field, `end`, is the address after the
            last array.
        sizes: Parameters of the layout, such as "n, m".
        functions: Functions that the shapes call.
        fields: Shape of each array: "n, m" for a matrix, "n" for a vector, "int n" for a vector of int64s, or a call
            "Other(at, n)" for a nested layout, by the name of its tuple. An array in the place of an earlier one names
            that after an equals sign, with a count of numbers to skip if any: "n, n = D" or "n, m = D + m".
    """
    lines = [f"def {kind}(at, {sizes}):"]
    for name, declared in fields.items():
        shape, _, place = declared.removeprefix("int ").partition(" = ")
        if "(at, " in shape:
            lines += [f"    _{name} = {shape}", f"    at = _{name}.end"]
        else:
            # A comma within parentheses separates arguments, not dimensions.
            matrix = isinstance(ast.parse(shape, mode="eval").body, ast.Tuple)
            integers = declared.startswith("int ")
            take = "take_integers" if integers else "take_matrix" if matrix else "take_vector"
            start, _, skipped = place.partition(" + ")
            begin = f"at_{start} + {WORD} * ({skipped or 0})" if place else "at"
            lines += [f"    at_{name} = {begin}", f"    _{name}, end = {take}(at_{name}, {shape})"]
            lines += [] if place else ["    at = end"]
    # No field of a named tuple begins with an underscore, so no local is called like the tuple.
    lines.append(f"    return __kind({', '.join(f'_{name}' for name in fields)}, at)")
    # As of namedtuple itself, the caller's module is where pickle finds the class again.
    module = sys._getframe(1).f_globals["__name__"]
    made: Any = namedtuple(kind, [*fields, "end"], module=module)  # type: ignore[misc]
    names: dict[str, Any] = {function.__name__: function for function in (*functions, *_TAKES)}
    names |= {"__name__": module, "__kind": made}
    exec("\n".join(lines), names)
    return made, layout(names[kind])


# Not inlined: where Numba inlines an overload it looks for dead code, and takes a write through a field of a tuple,
# `own.mean[i] = ...`, for dead.
@overload(take_matrix)
def _take_matrix(at, rows, columns):
    def impl(at, rows, columns):
        return carray(_to_float(at), (rows, columns)), at + WORD * rows * columns

    return impl


@overload(take_vector)
def _take_vector(at, n):
    def impl(at, n):
        return carray(_to_float(at), (n,)), at + WORD * n

    return impl


@overload(take_integers)
def _take_integers(at, n):
    def impl(at, n):
        return carray(_to_int(at), (n,)), at + WORD * n

    return impl


@intrinsic
def start_of(typing_context: object, work: types.Array) -> tuple[Signature, Callable]:
    """Return the address at which a scratch array begins (NumPy's `ctypes` takes longer to compile)."""

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, given: list[Value]) -> Value:
        return builder.ptrtoint(context.make_array(work)(context, builder, given[0]).data, context.get_value_type(i64))

    return i64(work), codegen


def size_of(workspace: Callable, *sizes: int) -> int:
    """How many float64s a workspace of these sizes takes; its last field is where it ends."""
    return int(plain(workspace)(0, *sizes)[-1]) // WORD


def view(part: ArrayLayout, array: np.ndarray) -> np.ndarray:
    """A part of a layout, called from address zero, as a view of the float64s that it lays out."""
    begin = part.at // WORD
    return array[begin : begin + int(np.prod(part.shape))].reshape(part.shape)


@jit
def after(work, end):
    """What of a scratch array follows a workspace that ends at the address `end`."""
    used = (end - start_of(work)) // WORD
    return floats(end, work.size - used)


@layout
def line_from(at: int) -> int:
    """Return the first address from `at` on that begins a cache line, so that no vector lies in two of them."""
    return (at + 63) // 64 * 64


@jit
def share(work, crew, crews):
    """The part of a scratch array that belongs to one of several crews."""
    each = work.size // crews
    return floats(start_of(work) + WORD * crew * each, each)
