"""A filter's scratch, laid out once: the views that a kernel works in, and how much room they take.

A filter declares its workspace as one function that takes arrays one after the other from an address:

    class Work(NamedTuple):
        D: Any
        mean: Any
        end: int

    @layout
    def workspace(at, n, m):
        D, at = take_matrix(at, 2 * n + 1, m)
        mean, at = take_vector(at, m)
        return Work(D, mean, at)

A kernel calls it with the address of its scratch, `start_of(work)`. The size follows from the same function, called
in Python from address zero without touching memory: `size_of(workspace, n, m)`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import carray
from numba.extending import overload, register_jitable

from .jit import _to_float, _to_int, floats, inlined, jit, plain

WORD = 8
"""Bytes of a float64."""

layout = register_jitable
"""Decorator of a layout that stands in others: in Python a plain function, within a kernel compiled."""


class Part(NamedTuple):
    """What a layout hands out in Python: where an array begins, in bytes, and its shape."""

    at: int
    shape: tuple[int, ...]


def take_matrix(at: int, rows: int, columns: int) -> tuple[Any, int]:
    """A matrix (rows, columns) that begins at the address `at`, and the address after it."""
    return Part(at, (rows, columns)), at + WORD * rows * columns


def take_vector(at: int, n: int) -> tuple[Any, int]:
    """A vector (n,) that begins at the address `at`, and the address after it."""
    return Part(at, (n,)), at + WORD * n


def take_integers(at: int, n: int) -> tuple[Any, int]:
    """A vector (n,) of int64s that begins at the address `at`, and the address after it."""
    return Part(at, (n,)), at + WORD * n


# Not inlined: where Numba inlines an overload it looks for dead code, and takes a write through a field of a tuple,
# `own.mean[i] = ...`, for dead.
@overload(take_matrix)
def _take_matrix(at, rows, columns):
    def take(at, rows, columns):
        return carray(_to_float(at), (rows, columns)), at + WORD * rows * columns

    return take


@overload(take_vector)
def _take_vector(at, n):
    def take(at, n):
        return carray(_to_float(at), (n,)), at + WORD * n

    return take


@overload(take_integers)
def _take_integers(at, n):
    def take(at, n):
        return carray(_to_int(at), (n,)), at + WORD * n

    return take


@inlined
def start_of(work):
    """The address at which a scratch array begins."""
    return work.ctypes.data


def size_of(workspace: Callable[..., Any], *sizes: int) -> int:
    """How many float64s a workspace of these sizes takes; its last field is where it ends."""
    return int(plain(workspace)(0, *sizes)[-1]) // WORD


def view(part: Part, array: np.ndarray) -> np.ndarray:
    """A part of a layout, called from address zero, as a view of the float64s that it lays out."""
    begin = part.at // WORD
    return array[begin : begin + int(np.prod(part.shape))].reshape(part.shape)


@jit
def after(work, end):
    """What of a scratch array follows a workspace that ends at the address `end`."""
    used = (end - work.ctypes.data) // WORD
    return floats(end, work.size - used)


@jit
def share(work, crew, crews):
    """The part of a scratch array that belongs to one of several crews."""
    each = work.size // crews
    return floats(work.ctypes.data + WORD * crew * each, each)
