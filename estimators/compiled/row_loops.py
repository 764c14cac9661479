"""A model's f and h looped over the rows of a block, as machine code with a slim calling convention.

Numba hands an array over as seven numbers, so that f(x, u, p, dt, out) takes 29, most of them through memory: 15 ns
a call, more than most models need to answer. The loop takes addresses instead, knows the sizes when it is compiled,
and has the model's own code inside it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from types import FunctionType
from typing import Any

from numba import types
from numba.core.serialize import dumps

from ..numerics.jit import by_address, caller, f64, floats, i64

f_rows_signature = types.void(i64, i64, i64, i64, i64, f64, i64, i64)
h_rows_signature = types.void(i64, i64, i64, i64, i64, i64, i64)

# What the templates below name, and `_looped` gives them for each model.
function: Any = None
NX = NU = PARAMETERS = NY = 0

call_f_rows = caller(f_rows_signature)
call_h_rows = caller(h_rows_signature)


def _f_rows(x, stride, n, u, p, dt, out, out_stride):
    for i in range(n):
        function(
            floats(x + 8 * i * stride, NX),
            floats(u, NU),
            floats(p, PARAMETERS),
            dt,
            floats(out + 8 * i * out_stride, NX),
        )


def _h_rows(x, stride, n, u, p, out, out_stride):
    for i in range(n):
        function(
            floats(x + 8 * i * stride, NX),
            floats(u, NU),
            floats(p, PARAMETERS),
            floats(out + 8 * i * out_stride, NY),
        )


def looped_f(f: Any, nx: int, nu: int, parameters: int) -> Any:
    """A dispatcher of f_rows(x, stride, n, u, p, dt, out, out_stride): f of n rows, `stride` numbers apart."""
    return _looped(_f_rows, f, {"NX": nx, "NU": nu, "PARAMETERS": parameters})


def looped_h(h: Any, nx: int, nu: int, parameters: int, ny: int) -> Any:
    """A dispatcher of h_rows(x, stride, n, u, p, out, out_stride): h of n rows, `stride` numbers apart."""
    return _looped(_h_rows, h, {"NX": nx, "NU": nu, "PARAMETERS": parameters, "NY": ny})


def _looped(template: Callable, dispatcher: Any, sizes: dict[str, int]) -> Any:
    """The template around a model's function, cached under the function's own file, line and name.

    Numba keys its cache by these, the bytecode and the closure, but not by globals; so the sizes, and what the
    function has in its closure, go into the name.
    """
    model = dispatcher.py_func
    closure = dumps(tuple(cell.cell_contents for cell in model.__closure__ or ()))
    digest = hashlib.sha256(repr(sizes).encode() + closure).hexdigest()[:12]
    name = f"{model.__name__}_rows_{digest}"
    code = template.__code__.replace(
        co_name=name, co_filename=model.__code__.co_filename, co_firstlineno=model.__code__.co_firstlineno
    )
    loop = FunctionType(code, {"function": dispatcher, "floats": floats, **sizes}, name)
    loop.__qualname__ = f"{model.__qualname__}_rows_{digest}"
    loop.__module__ = model.__module__
    return by_address(loop)
