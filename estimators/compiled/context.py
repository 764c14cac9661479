"""The context of a compiled filter: addresses of the model's code, layout, numbers of the tuning.

A model's f and h are called through loops over the rows of a block, `looped_f` and `looped_h`. Numba passes an array
as seven numbers, so a call f(x, u, p, dt, out) takes 29 of them, most through memory: 15 ns, more than most models need
to answer. The loop takes addresses instead, has its sizes as constants, and contains the model's own code.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from types import FunctionType
from typing import Any

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps
from numba.extending import intrinsic

from ..numerics.jit import (
    C1,
    F1,
    F2,
    by_address,
    caller,
    f64,
    flags,
    floats,
    i64,
    inlined,
    ints,
    jit,
    linkable_embedded,
    matrix,
    part,
    pointer,
)

f_signature = types.void(F1, F1, F1, f64, F1)
f_complex_signature = types.void(C1, F1, F1, f64, C1)
F_signature = types.void(F1, F1, F1, f64, F2)
h_signature = types.void(F1, F1, F1, F1)
h_complex_signature = types.void(C1, F1, F1, C1)
H_signature = types.void(F1, F1, F1, F2)
Q_signature = types.void(F1, F1, F1, F1, f64, F2)
shape_signature = types.void(F1, F1, F1)
log_likelihood_signature = f64(F1, F1, F1, F1, F1)

call_f_complex = caller(f_complex_signature)
call_F = caller(F_signature)
call_h_complex = caller(h_complex_signature)
call_H = caller(H_signature)
call_jump = caller(f_signature)
call_Q = caller(Q_signature)
call_shape = caller(shape_signature)
call_log_likelihood = caller(log_likelihood_signature)


_FIELDS = """
    nx nu n_parameters n_noises f f_complex F F_mode Q Q_varies each_state shape h h_complex H H_mode
    log_likelihood n_sensors row_start row_count n_rows circular_x circular_y correlation
    noise_state noise_states max_step
    prior_mean prior_cov prior_rows n_considered linear_states n_linear sampled_states n_sampled jump mode n_modes
    p q r used gate width options n_options pairs n_pairs shown n_shown prepared n_prepared n_memory seed
    baseline n_baseline normal ranges fitted expected chances gated marginal n_tests limits limited duplicates
    memory graded unwatched
""".split()

_layout = np.dtype([(name, np.float64 if name == "max_step" else np.int64) for name in _FIELDS])

context_type = from_dtype(_layout)
"""Read-only input of a compiled filter: the model's code and layout, the tuning, the options.

Plain numbers: sizes, modes, and addresses of code and of arrays, which the functions below turn into views. A record is
passed as one address; a tuple would be forty numbers in every call, and counting references of arrays costs more than a
step.
"""


def context_of(**values: float) -> np.void:
    """Make a context of these values.

    Raises:
        KeyError: If one is missing.
    """
    return np.array([tuple(values[name] for name in _FIELDS)], _layout)[0]


def place_of_record(context: np.void) -> int:
    """Return the address of a context, which must outlive it."""
    assert isinstance(context.base, np.ndarray)  # a record of its own would be copied
    return int(context.base.ctypes.data)


@intrinsic
def place_of(typing_context: object, context: types.Record) -> tuple[object, Callable]:
    """Return the address of a context, as a parallel loop takes no records."""

    def codegen(_: object, builder: ir.IRBuilder, signature: object, given: list[ir.Value]) -> ir.Value:
        return builder.ptrtoint(given[0], ir.IntType(64))

    return i64(context_type), codegen


context_at = pointer(context_type)


def with_parameters(context: np.void, p: np.ndarray) -> np.void:
    """Return a context with other parameters p, an array that must outlive it."""
    changed = np.array([context], _layout)
    changed["p"], changed["n_parameters"] = p.ctypes.data, p.size
    return changed[0]


@part
def parameters(context):
    """Return the model's parameters p."""
    return floats(context.p, context.n_parameters)


@part
def process_variances(context):
    """Return q (nw,), the variance that each process noise adds per second."""
    return floats(context.q, context.n_noises)


@inlined
def estimated(context):
    """Return the number of states that measurements correct: all but the last, considered ones."""
    return context.nx - context.n_considered


@part
def sensor_rows(context, sensor):
    """Return a sensor's first row among all rows, and the number of its rows."""
    return ints(context.row_start, context.n_sensors)[sensor], ints(context.row_count, context.n_sensors)[sensor]


@part
def sensor_variances(context, sensor):
    """Return r (ny,), the variances of one sensor's rows."""
    first, count = sensor_rows(context, sensor)
    return floats(context.r, context.n_rows)[first : first + count]


@part
def circular_states(context):
    """Return for each state whether it is an angle (int8)."""
    return flags(context.circular_x, context.nx)


@part
def circular_rows(context, sensor):
    """Return for each row of a sensor whether it is an angle (int8)."""
    first, count = sensor_rows(context, sensor)
    return flags(context.circular_y, context.n_rows)[first : first + count]


@part
def options(context):
    """Return the numbers that the estimator's `tune` made of its options."""
    return floats(context.options, context.n_options)


@part
def transition(context, x, u, dt, out):
    """out = f(x, u, p, dt)."""
    call_f_rows(context.f, x.ctypes.data, 0, 1, u.ctypes.data, context.p, dt, out.ctypes.data, 0)


@jit
def transition_points(context, X, u, dt, out):
    """Rows of `out` (N, nx or more) = f of the rows of X (N, nx or more)."""
    rows, stride = X.shape
    call_f_rows(context.f, X.ctypes.data, stride, rows, u.ctypes.data, context.p, dt, out.ctypes.data, out.shape[1])


@part
def expect(context, sensor, x, u, out):
    """out = h(x, u, p) of one sensor."""
    h = ints(context.h, context.n_sensors)[sensor]
    call_h_rows(h, x.ctypes.data, 0, 1, u.ctypes.data, context.p, out.ctypes.data, 0)


@jit
def expect_points(context, sensor, X, u, out):
    """Rows of `out` (N, ny or more) = h of one sensor at the rows of X (N, nx or more)."""
    h = ints(context.h, context.n_sensors)[sensor]
    rows, stride = X.shape
    call_h_rows(h, X.ctypes.data, stride, rows, u.ctypes.data, context.p, out.ctypes.data, out.shape[1])


@inlined
def add_process_noise(context, x, u, dt, P, scratch):
    """Add Q(x, u, p, q, dt) to P (nx, nx), or q·dt on the diagonal where the model gives no Q."""
    if context.Q == 0:
        first = ints(context.noise_state, context.n_noises)
        count = ints(context.noise_states, context.n_noises)
        q = process_variances(context)
        for k in range(q.size):
            for j in range(first[k], first[k] + count[k]):
                P[j, j] += q[k] * dt
    else:
        add_given_noise(context, x, u, dt, P, scratch)


@part
def add_given_noise(context, x, u, dt, P, scratch):
    """Add the model's own Q(x, u, p, q, dt) to P."""
    n = context.nx
    scratch[:] = 0.0
    call_Q(context.Q, x, u, parameters(context), process_variances(context), dt, scratch)
    for i in range(n):
        for j in range(n):
            P[i, j] += scratch[i, j]


@part
def prior(context):
    """Return mean (nx,) and covariance of the prior, (nx, nx), or (1, nx) if it is diagonal."""
    n = context.nx
    rows = context.prior_rows
    return floats(context.prior_mean, n), matrix(floats(context.prior_cov, rows * n), 0, rows, n)


@jit
def linear_states(context):
    """Return the indices of the conditionally linear states."""
    return ints(context.linear_states, context.n_linear)


@jit
def sampled_states(context):
    """Return the indices of the other states except the mode, if there is one (`context.mode`, or -1)."""
    return ints(context.sampled_states, context.n_sampled)


@jit
def jump_chances(context, x, u, dt, out):
    """out = the probability of each next mode (n_modes,), `dt` seconds on."""
    call_jump(context.jump, x, u, parameters(context), dt, out)


@part
def shown_states(context):
    """Return the index of the state in each of the track's columns."""
    return ints(context.shown, context.n_shown)


@jit
def shaped(context, z, out):
    """out = L z: white noise z (nx,) correlated in space as the model says."""
    call_shape(context.shape, z, parameters(context), out)


@jit
def has_own_likelihood(context, sensor):
    """Return whether the sensor has a likelihood function instead of r."""
    return ints(context.log_likelihood, context.n_sensors)[sensor] != 0


@jit
def own_likelihood(context, sensor, y, x, u):
    """Return log p(y | x) of a sensor with a likelihood function."""
    target = ints(context.log_likelihood, context.n_sensors)[sensor]
    return call_log_likelihood(target, y, x, u, parameters(context), sensor_variances(context, sensor))


f_rows_signature = types.void(i64, i64, i64, i64, i64, f64, i64, i64)
h_rows_signature = types.void(i64, i64, i64, i64, i64, i64, i64)

# Globals of the templates below, which `_looped` sets for each model.
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


def _h_rows_shared(x, stride, n, u, p, out, out_stride, more):
    for i in range(n):
        function(
            floats(x + 8 * i * stride, NX),
            floats(u, NU),
            floats(p, PARAMETERS),
            floats(out + 8 * i * out_stride, NY),
            *more,
        )


def looped_f(f: CPUDispatcher, nx: int, nu: int, parameters: int) -> CPUDispatcher:
    """Return a dispatcher of f_rows(x, stride, n, u, p, dt, out, out_stride): f of n rows, `stride` numbers apart."""
    return _looped(_f_rows, f, {"NX": nx, "NU": nu, "PARAMETERS": parameters})


def looped_h(h: CPUDispatcher, nx: int, nu: int, parameters: int, ny: int, *, shared: bool = False) -> CPUDispatcher:
    """Return a dispatcher of h_rows(x, stride, n, u, p, out, out_stride): h of n rows, `stride` numbers apart.

    With `shared` it takes one more argument, a tuple of further arguments of h.
    """
    template = _h_rows_shared if shared else _h_rows
    return _looped(template, h, {"NX": nx, "NU": nu, "PARAMETERS": parameters, "NY": ny})


def _looped(template: Callable, dispatcher: CPUDispatcher, sizes: dict[str, int]) -> CPUDispatcher:
    """Return the template around a model's function, cached under the function's own file, line and name.

    Numba keys its cache by these, the bytecode and the closure, but not by globals; so the sizes, and the closure of
    the function, are part of the name.
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


SLACK = 1e-3
"""Share of a step by which a step may be longer than `max_step`.

0.3 s in steps of 0.1 s are three, though 0.3 / 0.1 exceeds 3 in floating point; and so are three periods of 1/30 s,
though timestamps are whole nanoseconds. `max_step` bounds the error of integration, which a thousandth does not change.
"""


@linkable_embedded
def steps_of(dt: float, max_step: float) -> int:
    """Return the smallest number of equal steps over `dt` seconds of at most `max_step`, within `SLACK` of a step."""
    return max(1, int(math.ceil(dt / max_step - SLACK)))
