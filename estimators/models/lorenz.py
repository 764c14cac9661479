"""Lorenz's two chaotic models, each with one Runge-Kutta step of fourth order per step of the filter.

The convection model of 1963 has three states; steps are at most 0.01 long:

    dx/dt = σ (y - x),  dy/dt = x (ρ - z) - y,  dz/dt = x y - β z

The model of 1996 is a quantity on a circle of latitude, advected, damped and forced; steps are at most 0.05 long:

    dxᵢ/dt = (xᵢ₊₁ - xᵢ₋₂) xᵢ₋₁ - xᵢ + F,    indices around the circle

With F = 8 errors double in 0.42 time units (Lorenz's atmosphere: two days). Mean and spread of its prior are those of
the attractor.

Sources: Lorenz (1963), Deterministic nonperiodic flow, doi:10.1175/1520-0469(1963)020<0130:DNF>2.0.CO;2, with prior and
measurement noise as in Evensen & van Leeuwen (2000), doi:10.1175/1520-0493(2000)128<1852:AEKSFN>2.0.CO;2; Lorenz
(1996),
Predictability: a problem partly solved, ECMWF Seminar on Predictability, vol. 1, 1-18; Lorenz & Emanuel (1998),
doi:10.1175/1520-0469(1998)055<0399:OSFSWO>2.0.CO;2.
"""

from __future__ import annotations

from ..model.parts import Field
from ..model.rk4 import rk4
from ..model.state_space import Noise, Parameter, Row, Sensor, State, StateSpaceModel


def flow(x, u, p):
    """Return Lorenz's equations."""
    sigma, rho, beta = p[0], p[1], p[2]
    return sigma * (x[1] - x[0]), x[0] * (rho - x[2]) - x[1], x[0] * x[1] - beta * x[2]


def stations(x, u, p, out):
    """Measure every state."""
    for i in range(x.size):
        out[i] = x[i]


LORENZ63 = StateSpaceModel(
    name="lorenz63",
    title="Lorenz 63: the butterfly",
    states=(
        State("x", "1", mean=1.509, std=1.414),
        State("y", "1", mean=-1.531, std=1.414),
        State("z", "1", mean=25.46, std=1.414),
    ),
    parameters=(
        Parameter("sigma", "1", 10.0, 0.0, 100.0),
        Parameter("rho", "1", 28.0, 0.0, 200.0),
        Parameter("beta", "1", 8.0 / 3.0, 0.0, 20.0),
    ),
    # Noise of the model as tuned by those authors: 2, 12.13 and 12.31 a unit of time.
    noises=(
        Noise("x", "1/s", variance=2.0),
        Noise("y", "1/s", variance=12.13),
        Noise("z", "1/s", variance=12.31),
    ),
    sensors=(
        Sensor(
            "position",
            (Row("x", "1", variance=2.0), Row("y", "1", variance=2.0), Row("z", "1", variance=2.0)),
            h=stations,
        ),
    ),
    f=rk4(flow),
    max_step=0.01,
    source="Lorenz (1963), doi:10.1175/1520-0469(1963)020<0130:DNF>2.0.CO;2",
)


N = 40


def advection(x, u, p, out):
    """Fill the rates of all states."""
    n = x.size
    for i in range(2, n - 1):
        out[i] = (x[i + 1] - x[i - 2]) * x[i - 1] - x[i] + p[0]
    for i in (0, 1, n - 1):
        out[i] = (x[(i + 1) % n] - x[(i - 2) % n]) * x[(i - 1) % n] - x[i] + p[0]


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
    f=rk4(advection),
    max_step=0.05,
    source="Lorenz (1996), Predictability: a problem partly solved, ECMWF; sampling as in Sakov & Oke (2008)",
)
