"""Lorenz's convection of 1963: three states whose future no digit of the present fixes for long.

    dx/dt = σ (y - x),  dy/dt = x (ρ - z) - y,  dz/dt = x y - β z

Integrated by one Runge-Kutta step of fourth order a step of the filter, at most 0.01 long.

Source: Lorenz (1963), Deterministic nonperiodic flow, doi:10.1175/1520-0469(1963)020<0130:DNF>2.0.CO;2; prior and noise
of the readings as in Evensen & van Leeuwen (2000), doi:10.1175/1520-0493(2000)128<1852:AEKSFN>2.0.CO;2.
"""

from __future__ import annotations

from ..model.state_space import Noise, Parameter, Row, Sensor, State, StateSpaceModel


def f(x, u, p, dt, out):
    """One classical Runge-Kutta step."""
    sigma, rho, beta = p[0], p[1], p[2]
    a, b, c = x[0], x[1], x[2]
    a1, b1, c1 = sigma * (b - a), a * (rho - c) - b, a * b - beta * c
    h = 0.5 * dt
    a, b, c = x[0] + h * a1, x[1] + h * b1, x[2] + h * c1
    a2, b2, c2 = sigma * (b - a), a * (rho - c) - b, a * b - beta * c
    a, b, c = x[0] + h * a2, x[1] + h * b2, x[2] + h * c2
    a3, b3, c3 = sigma * (b - a), a * (rho - c) - b, a * b - beta * c
    a, b, c = x[0] + dt * a3, x[1] + dt * b3, x[2] + dt * c3
    a4, b4, c4 = sigma * (b - a), a * (rho - c) - b, a * b - beta * c
    out[0] = x[0] + dt / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    out[1] = x[1] + dt / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
    out[2] = x[2] + dt / 6.0 * (c1 + 2.0 * c2 + 2.0 * c3 + c4)


def position(x, u, p, out):
    """All three, read directly."""
    out[0] = x[0]
    out[1] = x[1]
    out[2] = x[2]


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
            h=position,
        ),
    ),
    f=f,
    max_step=0.01,
    source="Lorenz (1963), doi:10.1175/1520-0469(1963)020<0130:DNF>2.0.CO;2",
)
