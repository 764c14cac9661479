"""How Nisus compiles: Numba, once, cached where the user can write, called through plain addresses.

A filter receives a model as addresses of machine code, so one compiled set of filters serves every model. Addresses
are plain integers in a tuple: a call from Python with them costs 3 µs, against 100 µs with `FunctionType` objects.
"""

from __future__ import annotations

import operator
import os
from collections.abc import Callable
from functools import cached_property, lru_cache, partial
from typing import Any
from uuid import NAMESPACE_OID, uuid5

import numba
import numpy as np
from llvmlite.ir import IRBuilder, Value
from numba import carray, njit, types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.core.registry import CPUDispatcher
from numba.core.typing import Signature
from numba.experimental.function_type import _get_jit_address
from numba.extending import intrinsic, lower_builtin, overload, register_jitable

from .cache import cache_folder
from .cache_entries import Linked, use_entries

F1 = types.float64[::1]
F2 = types.Array(types.float64, 2, "C")
C1 = types.complex128[::1]
I1 = types.int64[::1]
I2 = types.Array(types.int64, 2, "C")
B1 = types.int8[::1]

f64 = types.float64
i64 = types.int64


if "NUMBA_CACHE_DIR" not in os.environ:
    numba.config.CACHE_DIR = str(cache_folder())
use_entries()

# Vectors of a few entries lose more to the set-up of a vectorised loop than they gain: without it the filters take 20
# to 30 % less time at n = 2 to 4, and no more at n = 48.
numba.config.LOOP_VECTORIZE = 0

# OpenMP's threads wait for each other by spinning. On a busy machine the one that spins keeps the core from the one it
# waits for until its time slice of some milliseconds is over: loops on two threads took 4 times as long as on one. The
# library reads this when it is loaded, which `threaded` does.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

jit = partial(njit, cache=True, nogil=True, error_model="numpy", forceinline=False, no_cfunc_wrapper=True)
"""Numba's njit as used here: cached, without the GIL, and with IEEE division (zero divisors give inf, no error).

Numba compiles two wrappers around each function; the one for C is left out, as nothing calls it. Where
`forceinline` is not given, a function has that of the caller which is compiled first: so a step's time depended on the
order in which filters were compiled, by 15 %.
"""


class Inner(CPUDispatcher):  # type: ignore[misc]
    """Function that compiled callers link, see `Linked`. Called from Python, it runs as plain Python."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Run it uncompiled."""
        return self.py_func(*args, **kwargs)


def inner(function: Callable, forceinline: bool = False) -> Inner:
    """`jit` for what functions of a model call: without machine code of its own that takes a third less time."""
    made = jit(pipeline_class=Linked, forceinline=forceinline)(function)
    made.__class__, made._cache.linked = Inner, True
    return made


class TwoForms(CPUDispatcher):  # type: ignore[misc]
    """Compiled function with machine code for calls from Python, and bitcode alone for compiled callers."""

    forceinline = False

    @cached_property
    def linked(self) -> Inner:
        """What compiled callers link, see `Linked`."""
        return inner(self.py_func, self.forceinline)

    @property
    def _numba_type_(self) -> types.Type:
        """Type of the function for a compiled caller."""
        return self.linked._numba_type_


def linkable(function: Callable, forceinline: bool = False) -> TwoForms:
    """`jit` for functions of filters that Python calls, too, or tests do: each form is compiled when first needed."""
    made = jit(function)
    made.__class__, made.forceinline = TwoForms, forceinline
    return made


linkable_embedded = partial(linkable, forceinline=True)
"""`linkable` for functions that each event needs, copied into their compiled callers, as with `embedded`."""


jit_brief = partial(njit, cache=True, error_model="numpy", forceinline=False, no_cfunc_wrapper=True)
"""`jit` with the GIL, for calls of microseconds that run no model function: after releasing the GIL, a thread waits for
it behind others."""


class AddressOnly(CPUDispatcher):  # type: ignore[misc]
    """Compiled function without a wrapper for Python: a call from Python is an error, where Numba ends the program."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Refuse the call."""
        raise TypeError(f"{self.__name__} is called by compiled code only; call its `py_func` from Python")


def by_address(function: Callable) -> AddressOnly:
    """`jit` for functions that are called only by compiled code or through their address.

    Not for a function that is also compiled by `jit`, as the cache does not distinguish the two.
    """
    made = jit(no_cpython_wrapper=True)(function)
    made.__class__ = AddressOnly
    return made


part: Callable[[Callable], Callable] = register_jitable(
    cache=True, nogil=True, error_model="numpy", forceinline=False, pipeline_class=Linked
)
"""`jit` for functions that only compiled functions call, without the wrapper for Python, which takes a third of the
compile time. Called from Python, the function runs as plain Python."""

embedded: Callable[[Callable], Callable] = register_jitable(
    cache=True, nogil=True, error_model="numpy", forceinline=True, pipeline_class=Linked
)
"""`part` for a long helper in the steps of several filters: compiled once, and copied into each caller by LLVM.

`inlined` would compile it again in each caller; for a short helper that is cheaper than a unit of its own."""


def named(made: CPUDispatcher) -> CPUDispatcher:
    """Give a compiled function of a module an identifier made from its name.

    Numba distinguishes closures by their content, a compiled function by its code and an identifier that is random in
    every process: code of a closure in which such a function occurs would never be found in the cache.
    """
    made._set_uuid(str(uuid5(NAMESPACE_OID, f"{made.py_func.__module__}.{made.py_func.__qualname__}")))
    return made


def inlined(function: Callable) -> CPUDispatcher:
    """`jit` for helpers inside a filter's step, where a call that hands over context and arrays costs 50 to 100 ns."""
    return named(jit(function, inline="always"))


def inner_embedded(function: Callable) -> Inner:
    """`inner` for what such functions of a module call: it is copied into its compiled callers, as with `embedded`."""
    return named(inner(function, forceinline=True))


def plain(function: Any) -> Callable:
    """Return the Python function of a compiled one; any other function unchanged."""
    return getattr(function, "py_func", function)  # type: ignore[no-any-return]


def address(dispatcher: CPUDispatcher, signature: Signature) -> int:
    """Compile `dispatcher` for `signature` (or load it from the cache) and return where its machine code starts.

    The dispatcher must be kept alive for as long as the address is used. Threads are loaded first: code from the cache
    may call for them.
    """
    threaded()
    dispatcher.compile(signature.args)
    return int(_get_jit_address(dispatcher, signature))


def caller(signature: Signature) -> Callable:
    """Return a function for compiled code, `call(address, *args)`, which calls the function at `address`."""
    args, result = signature.args, signature.return_type

    @intrinsic
    def call(typing_context: object, target: types.Type, *values: types.Type) -> tuple[Signature, Callable]:
        def codegen(context: BaseContext, builder: IRBuilder, _: Signature, given: list[Value]) -> Value:
            function_type = context.call_conv.get_function_type(result, args)
            pointer = builder.inttoptr(given[0], function_type.as_pointer())
            unpacked = cgutils.unpack_tuple(builder, given[1], len(args))
            status, value = context.call_conv.call_function(builder, pointer, result, args, unpacked)
            with cgutils.if_unlikely(builder, status.is_error):
                context.call_conv.return_status_propagate(builder, status)
            return context.get_dummy_value() if result == types.void else value

        return result(i64, types.StarArgTuple(args)), codegen

    return call


def pointer(kind: types.Type) -> Callable:
    """Return a function for compiled code that reads an integer as an address, that of a pointer or a record."""

    @intrinsic
    def read(typing_context: object, target: types.Type) -> tuple[Signature, Callable]:
        def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, given: list[Value]) -> Value:
            return builder.inttoptr(given[0], context.get_value_type(signature.return_type))

        return kind(i64), codegen

    return read


_to_float, _to_int, _to_byte, _to_mask, _to_complex = (
    pointer(types.CPointer(element))
    for element in (types.float64, types.int64, types.int8, types.int32, types.complex128)
)


@embedded
def floats(target, n):
    """Return the n float64s at an address as an array without reference counts, which cost more than the filter."""
    return carray(_to_float(target), (n,))


@part
def ints(target, n):
    """Return the n int64s at an address."""
    return carray(_to_int(target), (n,))


@part
def flags(target, n):
    """Return the n int8s at an address."""
    return carray(_to_byte(target), (n,))


@part
def flag_rows(target, rows, columns):
    """Return the (rows, columns) int8s at an address."""
    return carray(_to_byte(target), (rows, columns))


@part
def counts(target, n):
    """Return the n int32s at an address."""
    return carray(_to_mask(target), (n,))


@part
def masks(target, rows, columns):
    """Return the (rows, columns) int32s at an address."""
    return carray(_to_mask(target), (rows, columns))


@embedded
def matrix(vector, start, rows, columns):
    """Return a view of `vector` from `start` on as a matrix (NumPy's reshape costs 50 ns here)."""
    return carray(_to_float(vector.ctypes.data + 8 * start), (rows, columns))


@part
def complexes(scratch, start, n):
    """Return a view of the float64s of `scratch` from `start` on as n complex numbers."""
    return carray(_to_complex(scratch.ctypes.data + 8 * start), (n,))


@intrinsic
def _on_stack(typing_context: object, like: types.Type, entries: types.Type) -> tuple[Signature, Callable]:
    """Return the address of room on the stack for as many numbers of the kind of `like` as a tuple has entries."""

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, given: list[Value]) -> Value:
        return cgutils.alloca_once(builder, context.get_data_type(like), size=max(1, entries.count))

    return types.CPointer(like)(like, entries), codegen


def stack_vector(like: Any, entries: Any) -> Any:
    """Return a new vector of the kind of the number `like`, with as many numbers as the tuple `entries` has.

    Compiled, it lies on the stack of the caller, who may not return it: other memory takes 30 to 50 ns.
    """
    return np.empty(len(entries), type(like))


@overload(stack_vector, inline="always", jit_options={"error_model": "numpy"})
def _stack_vector(like: Any, entries: Any) -> Callable:
    def made(like: Any, entries: Any) -> Any:
        return carray(_on_stack(like, entries), (len(entries),))

    return made


@intrinsic
def _data_of(typing_context: object, array: types.Array) -> tuple[Signature, Callable]:
    """Return a pointer to the first element of an array."""

    def codegen(context: BaseContext, builder: IRBuilder, signature: Signature, given: list[Value]) -> Value:
        return context.make_array(array)(context, builder, given[0]).data

    return types.CPointer(array.dtype)(array), codegen


@part
def borrowed(array):
    """Return a view of a contiguous array without reference counts, which each call counts up and down.

    The array itself must be used, or belong to a caller, for as long as the view.
    """
    return carray(_data_of(array), array.shape)


@lower_builtin(operator.truediv, types.complex128, types.complex128)
def _divide_complex(context: BaseContext, builder: IRBuilder, signature: Signature, given: list[Value]) -> Value:
    """Divide as Numba does, but give NaN for a zero divisor.

    Numba raises ZeroDivisionError there in every error model, from a derivative of f or h in the middle of a fold. As
    with real numbers, the estimate is then not finite and the twin reports that it has diverged.

    Source: Smith (1962), Algorithm 116, doi:10.1145/368637.368661.
    """

    def divide(a, b):
        if abs(b.real) >= abs(b.imag):
            if b.real == 0.0:
                return complex(np.nan, np.nan)
            ratio = b.imag / b.real
            divisor = b.real + b.imag * ratio
            return complex((a.real + a.imag * ratio) / divisor, (a.imag - a.real * ratio) / divisor)
        if abs(b.imag) >= abs(b.real):
            ratio = b.real / b.imag
            divisor = b.real * ratio + b.imag
            return complex((a.real * ratio + a.imag) / divisor, (a.imag * ratio - a.real) / divisor)
        return complex(np.nan, np.nan)

    return context.compile_internal(builder, divide, signature, given)


@lru_cache(maxsize=1)
def threaded() -> bool:
    """True if Numba's threads can be started from several Python threads at once (its OpenMP or TBB layer).

    Its third layer, `workqueue`, aborts the process when two folds use it at the same time; then, and on one core, the
    loops run on the caller's thread. The results are the same bits either way.

    The call also loads the layer, which machine code from the cache needs: without it LLVM ends the process.
    """
    from numba.np.ufunc.parallel import _launch_threads

    if "NUMBA_THREADING_LAYER" not in os.environ:
        numba.config.THREADING_LAYER = "threadsafe"
    try:
        _launch_threads()
    except ValueError:
        numba.config.THREADING_LAYER = "default"
        _launch_threads()
        return False
    return numba.threading_layer() in ("omp", "tbb") and numba.config.NUMBA_NUM_THREADS > 1
