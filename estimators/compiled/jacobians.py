"""Derivatives of a model's f and h: analytic, by complex step, or by central differences.

Complex step: df/dx_j = Im f(x + i·e·e_j) / e, exact to rounding for an analytic f, since nothing is subtracted.
Source: Squire & Trapp (1998), doi:10.1137/S003614459631241X.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..numerics.jit import complexes, floats, ints, linkable, matrix, part
from ..numerics.linalg import copy, wrap
from ..numerics.workspace import layout
from .context import (
    call_F,
    call_f_complex,
    call_H,
    call_h_complex,
    circular_rows,
    circular_states,
    expect,
    parameters,
    transition,
)

ANALYTIC, COMPLEX_STEP, CENTRAL, CONSTANT = range(4)
"""Method of a Jacobian: the model's own function, complex step, central differences, or the same at every state."""


@layout
def scratch_size(nx: int, ny: int) -> int:
    """Return the scratch of a Jacobian: two complex vectors, or three real ones."""
    return 2 * nx + 2 * max(nx, ny)


_COMPLEX_STEP = 1e-20
CENTRAL_STEP = 6e-6  # about the cube root of the rounding error, where truncation and rounding balance


@linkable
def complex_step(target, of_sensor, x, u, p, dt, J, scratch):
    """Fill J (m, nx) with df/dx, or of a sensor dh/dx, of the complex function at address `target`."""
    m, n = J.shape
    z = complexes(scratch, 0, n)
    out = complexes(scratch, 2 * n, m)
    for i in range(n):
        z[i] = x[i]
    for j in range(n):
        z[j] = complex(x[j], _COMPLEX_STEP)
        if of_sensor:
            call_h_complex(target, z, u, p, out)
        else:
            call_f_complex(target, z, u, p, dt, out)
        z[j] = x[j]
        for i in range(m):
            J[i, j] = out[i].imag / _COMPLEX_STEP


def constant_rows(
    static: Mapping[str, np.ndarray], p: np.ndarray, rows: list[int], nx: int
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return `H` and `H_mode` of a linear model without inputs, whose dh/dx is the same at every state.

    Only for complex step, which gives the same bits at every state. The arrays must outlive the context.

    Args:
        static: Entries of the compiled model.
        p: Parameters.
        rows: Number of rows of each sensor.
        nx: Number of states.
    """
    H, mode, made = static["H"].copy(), static["H_mode"].copy(), []
    for k in np.flatnonzero(mode == COMPLEX_STEP).tolist():
        J = np.empty((rows[k], nx))
        scratch = np.empty(scratch_size(nx, rows[k]))
        complex_step(static["h_complex"][k], True, static["prior_mean"], np.empty(0), p, 0.0, J, scratch)
        H[k], mode[k] = J.ctypes.data, CONSTANT
        made.append(J)
    return H, mode, made


@part
def _central(context, sensor, x, u, dt, J, scratch):
    """Fill J (m, nx) with df/dx, or of a sensor from 0 on with dh/dx, by central differences."""
    m, n = J.shape
    z = scratch[:n]
    high = scratch[n : n + m]
    low = scratch[n + m : n + 2 * m]
    circular = circular_rows(context, sensor) if sensor >= 0 else circular_states(context)
    for i in range(n):
        z[i] = x[i]
    for j in range(n):
        step = CENTRAL_STEP * max(1.0, abs(x[j]))
        z[j] = x[j] + step
        above = z[j]
        _image(context, sensor, z, u, dt, high)
        z[j] = x[j] - step
        below = z[j]
        _image(context, sensor, z, u, dt, low)
        z[j] = x[j]
        for i in range(m):
            difference = high[i] - low[i]
            # An angle may jump by 2π between the two: a model that wraps, atan2 on its cut.
            if circular[i] != 0:
                difference = wrap(difference)
            J[i, j] = difference / (above - below)


@part
def _image(context, sensor, x, u, dt, out):
    if sensor >= 0:
        expect(context, sensor, x, u, out)
    else:
        transition(context, x, u, dt, out)


@linkable
def state_jacobian(context, x, u, dt, F, scratch):
    """Fill F (nx, nx) with df/dx at x; `scratch` has `scratch_size` numbers."""
    if context.F_mode == ANALYTIC:
        call_F(context.F, x, u, parameters(context), dt, F)
    elif context.F_mode == COMPLEX_STEP:
        complex_step(context.f_complex, False, x, u, parameters(context), dt, F, scratch)
    else:
        _central(context, -1, x, u, dt, F, scratch)


@linkable
def sensor_jacobian(context, sensor, x, u, H, scratch):
    """Fill H (ny, nx) with dh/dx of one sensor at x; `scratch` has `scratch_size` numbers."""
    mode = ints(context.H_mode, context.n_sensors)[sensor]
    if mode == ANALYTIC:
        call_H(ints(context.H, context.n_sensors)[sensor], x, u, parameters(context), H)
    elif mode == CONSTANT:
        constant = floats(ints(context.H, context.n_sensors)[sensor], H.size)
        copy(matrix(constant, 0, H.shape[0], H.shape[1]), H)
    elif mode == COMPLEX_STEP:
        target = ints(context.h_complex, context.n_sensors)[sensor]
        complex_step(target, True, x, u, parameters(context), 0.0, H, scratch)
    else:
        _central(context, sensor, x, u, 0.0, H, scratch)
