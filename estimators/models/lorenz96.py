"""Lorenz's model of 1996: a quantity on a circle of latitude, carried along, damped and forced; chaos in 40 states.

    dxᵢ/dt = (xᵢ₊₁ - xᵢ₋₂) xᵢ₋₁ - xᵢ + F

with indices around the circle. With F = 8 errors double in 0.42 time units (Lorenz's atmosphere: two days). Integrated
by one Runge-Kutta step of fourth order a step of the filter, at most 0.05 long.

Source: Lorenz (1996), Predictability: a problem partly solved, ECMWF Seminar on Predictability, vol. 1, 1-18; Lorenz &
Emanuel (1998), doi:10.1175/1520-0469(1998)055<0399:OSFSWO>2.0.CO;2. Mean and spread of the prior are the attractor's.
"""

from __future__ import annotations

import numpy as np

from ..model.state_space import Noise, Parameter, Row, Sensor, StateSpaceModel
from ..model.states import Field
from ..numerics.jit import jit

N = 40


@jit
def tendency(x, forcing, out):
    """dx/dt."""
    n = x.size
    for i in range(2, n - 1):
        out[i] = (x[i + 1] - x[i - 2]) * x[i - 1] - x[i] + forcing
    for i in (0, 1, n - 1):
        out[i] = (x[(i + 1) % n] - x[(i - 2) % n]) * x[(i - 1) % n] - x[i] + forcing


def f(x, u, p, dt, out):
    """One classical Runge-Kutta step."""
    n = x.size
    k = np.empty_like(x)
    at = np.empty_like(x)
    tendency(x, p[0], k)
    for i in range(n):
        out[i] = x[i] + dt / 6.0 * k[i]
        at[i] = x[i] + 0.5 * dt * k[i]
    tendency(at, p[0], k)
    for i in range(n):
        out[i] += dt / 3.0 * k[i]
        at[i] = x[i] + 0.5 * dt * k[i]
    tendency(at, p[0], k)
    for i in range(n):
        out[i] += dt / 3.0 * k[i]
        at[i] = x[i] + dt * k[i]
    tendency(at, p[0], k)
    for i in range(n):
        out[i] += dt / 6.0 * k[i]


def stations(x, u, p, out):
    """Every state, read directly."""
    for i in range(x.size):
        out[i] = x[i]


LORENZ96 = StateSpaceModel(
    name="lorenz96",
    title="Lorenz 96: chaos on a circle of 40 states",
    states=Field("x", "1", (N,), periodic=(True,), mean=2.34, std=3.63),
    parameters=(Parameter("forcing", "1", 8.0, 0.0, 20.0),),
    noises=(Noise("x", "1/s", variance=0.001),),
    sensors=(
        Sensor(
            "stations",
            tuple(Row(f"x{i}", "1", variance=1.0, position=(float(i),)) for i in range(N)),
            h=stations,
        ),
    ),
    f=f,
    max_step=0.05,
    source="Lorenz (1996), Predictability: a problem partly solved, ECMWF; sampling as in Sakov & Oke (2008)",
)
