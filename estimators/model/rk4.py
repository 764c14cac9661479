"""The step of a model from its rates, by the classical Runge-Kutta method of fourth order.

    f = rk4(dxdt)      k1 = dxdt(x),  k2 = dxdt(x + dt/2 k1),  k3 = dxdt(x + dt/2 k2),  k4 = dxdt(x + dt k3)
                       x' = x + dt/6 (k1 + 2 k2 + 2 k3 + k4)

The error of a step is of order dt^5, that over a fixed time of order dt^4.

Source: Hairer, Nørsett & Wanner (1993), Solving Ordinary Differential Equations I, section II.1.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from hashlib import sha256
from types import FunctionType
from typing import Any

import numpy as np


def _inputs_and_parameters(u, p):
    return u, p


def rk4(dxdt: Callable, constants: Callable = _inputs_and_parameters) -> Callable[..., None]:
    """Return the step `f(x, u, p, dt, out)` of a model with the rates `dxdt`; inputs are held over the step.

    Args:
        dxdt: Rates, units of the states per second: `dxdt(x, u, p)` returns a tuple of nx floats, or, for many states,
            `dxdt(x, u, p, out)` fills `out` (nx,). The first form also takes x as a tuple if it only indexes it.
        constants: Terms of the first form that do not depend on x: `dxdt(x, *constants(u, p))`, computed once a step.
    """
    # Plain functions: compiling a model compiles them too, and keeps the result by their sources.
    rates, terms = (getattr(item, "py_func", item) for item in (dxdt, constants))
    fills = len(inspect.signature(rates).parameters) == 4 and constants is _inputs_and_parameters
    step = FunctionType((_step_in_place if fills else _step).__code__, {**globals(), "dxdt": rates, "constants": terms})
    # Values that the functions enclose are not part of their sources.
    enclosed = repr([cell.cell_contents for item in (rates, terms) for cell in item.__closure__ or ()])
    step.__qualname__ = f"rk4.{rates.__module__}.{rates.__qualname__}.{sha256(enclosed.encode()).hexdigest()[:12]}"
    return step


# Both steps are templates, in which `rk4` binds these names.
dxdt: Any = None
constants: Any = None


def _step(x, u, p, dt, out):
    """One step; `out` also holds the states of the stages, so that nothing is allocated."""
    c = constants(u, p)
    h = 0.5 * dt
    k1 = dxdt(x, *c)
    for i in range(len(k1)):
        out[i] = x[i] + h * k1[i]
    k2 = dxdt(out, *c)
    for i in range(len(k1)):
        out[i] = x[i] + h * k2[i]
    k3 = dxdt(out, *c)
    for i in range(len(k1)):
        out[i] = x[i] + dt * k3[i]
    k4 = dxdt(out, *c)
    for i in range(len(k1)):
        out[i] = x[i] + dt / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])


def _step_in_place(x, u, p, dt, out):
    """One step that adds the stages up in `out`, so that it needs two vectors of scratch and not five."""
    k, at = np.empty_like(x), np.empty_like(x)
    dxdt(x, u, p, k)
    for i in range(x.size):
        out[i] = x[i] + dt / 6.0 * k[i]
        at[i] = x[i] + 0.5 * dt * k[i]
    dxdt(at, u, p, k)
    for i in range(x.size):
        out[i] += dt / 3.0 * k[i]
        at[i] = x[i] + 0.5 * dt * k[i]
    dxdt(at, u, p, k)
    for i in range(x.size):
        out[i] += dt / 3.0 * k[i]
        at[i] = x[i] + dt * k[i]
    dxdt(at, u, p, k)
    for i in range(x.size):
        out[i] += dt / 6.0 * k[i]
