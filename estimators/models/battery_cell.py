"""One lithium-ion cell as an equivalent circuit: charge, polarisation, temperature.

    dz/dt  = -i / C                                    z state of charge, i > 0 discharges
    dV1/dt = (R1 g(T) (1 + k e^(-z / 0.05)) i - V1) / τ1
    m dT/dt = i (R0 g(T) i + V1) - (T - T_air) / R_air
    v = U(z) + e - V1 - R0 g(T) i,  g(T) = exp(B (1 / T - 1 / 298.15 K))

U is a monotone cubic through its values at 14 states of charge, which are parameters; outside 0 to 1 it is linear. R1
rises when the cell is nearly empty, where diffusion cannot follow. C1 = τ1 / R1. Entropic heat is left out. e is zero;
estimated jointly, it stands for hysteresis and ageing, which shift U for hours. z is exact for a constant current, and
so is V1 but for R1, which is held over a step; T takes Euler steps of at most 2 s, against minutes of its own.

The values are of a Panasonic NCR18650PF of 2.9 Ah at 25 °C, from the recordings of P. Kollmeyer, Panasonic 18650PF
Li-ion Battery Data (2018), doi:10.17632/wykht8y7tg.1, CC BY 4.0: least squares of the simulated voltage and
temperature, with z from the tester's charge counter, over the pulses (HPPC) and US06 at 25 °C; U is drawn to the
discharge at C/20, and B, which recordings at one temperature do not identify, is held at 2000 K. The error of the
simulation is 22 mV and 0.7 K over the pulses (15 mV above 10 % of charge), and 28 mV and 0.5 K over US06 (RMS).

Sources: Plett (2004), Extended Kalman filtering for battery management systems of LiPB-based HEV battery packs,
doi:10.1016/j.jpowsour.2004.02.032, for state of charge and circuit as states; Bernardi, Pawlikowski & Newman (1985),
doi:10.1149/1.2113792, for the heat; Fritsch & Butland (1984), doi:10.1137/0905021, for the slopes of U.
"""

from __future__ import annotations

import numpy as np

from ..model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from ..numerics.jit import jit

NODES = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""States of charge at which the open-circuit voltage is given."""


NEARLY_EMPTY = 0.05  # State of charge over which the rise of R1 fades by e


OPEN_CIRCUIT = (2.712, 3.092, 3.241, 3.346, 3.386, 3.454, 3.535, 3.598, 3.668, 3.767, 3.860, 3.949, 4.063, 4.165)


TEMPERATURES = (20.0, 38.0)
"""Range of validity, °C: the recordings of the fit reached from 25.3 to 33.0 °C, and within 5 °C of that an error of
1000 K in B, which they do not identify, moves the resistances by 6 % at most."""


CURRENTS = (-7.6, 20.9)  # Currents of those recordings, A: charged by US06's braking, discharged by its sprints


COMMON = (
    *(
        Parameter(f"ocv_{round(100 * node):02d}", "V", volts, 2.0, 4.5)
        for node, volts in zip(NODES, OPEN_CIRCUIT, strict=True)
    ),
    Parameter("r1", "Ω", 0.0319, 1e-4, 0.5),
    Parameter("tau_1", "s", 51.6, 0.5, 5e3),
    Parameter("r1_rise", "1", 13.5, 0.0, 100.0),
    Parameter("activation", "K", 2000.0, 0.0, 1e4),
    Parameter("heat_capacity", "J/K", 77.3, 5.0, 500.0),
    Parameter("to_air", "K/W", 8.2, 0.5, 100.0),
)
"""Parameters that a pack's cells share: U at 0 %, 2 %, ... of charge, R1, τ1, k, B, m, R_air."""


R1, TAU_1, R1_RISE, ACTIVATION, HEAT_CAPACITY, TO_AIR = range(len(NODES), len(COMMON))


CAPACITY, R0, OCV_ERROR = range(len(COMMON), len(COMMON) + 3)


CURRENT, AIR = range(2)


SOC, V1, TEMPERATURE = range(3)


@jit
def mean_slope(before, after, width_before, width_after):
    """Return the slope at a node between two intervals of those slopes and widths.

    It is zero at an extremum, otherwise a weighted harmonic mean.

    Source: Fritsch & Butland (1984), doi:10.1137/0905021, as in PCHIP.
    """
    if (before * after).real <= 0.0:
        return 0.0 * before
    a = 2.0 * width_after + width_before
    b = width_after + 2.0 * width_before
    return (a + b) * before * after / (a * after + b * before)


@jit
def open_circuit(z, p):
    """Return U and dU/dz, V, at the state of charge z."""
    last = len(NODES) - 1
    k = 0
    while k < last - 1 and z.real > NODES[k + 1]:
        k += 1
    h = NODES[k + 1] - NODES[k]
    d = (p[k + 1] - p[k]) / h
    a, b = d, d
    if k > 0:
        before = NODES[k] - NODES[k - 1]
        a = mean_slope((p[k] - p[k - 1]) / before, d, before, h)
    if k < last - 1:
        after = NODES[k + 2] - NODES[k + 1]
        b = mean_slope(d, (p[k + 2] - p[k + 1]) / after, h, after)
    if z.real <= 0.0:
        return p[0] + a * z, a + 0.0 * z
    if z.real >= 1.0:
        return p[last] + b * (z - 1.0), b + 0.0 * z
    s = (z - NODES[k]) / h
    c2 = 3.0 * d - 2.0 * a - b
    c3 = a + b - 2.0 * d
    return p[k] + h * s * (a + s * (c2 + s * c3)), a + s * (2.0 * c2 + 3.0 * s * c3)


@jit
def warmth(celsius, p):
    """Return g(T) and dg/dT: resistances relative to 25 °C."""
    kelvin = celsius + 273.15
    g = np.exp(p[ACTIVATION] * (1.0 / kelvin - 1.0 / 298.15))
    return g, -g * p[ACTIVATION] / kelvin**2


@jit
def rise(z, p):
    """Return 1 + k exp(-z / 0.05) and its derivative; below empty it is constant."""
    if z.real < 0.0:
        return 1.0 + p[R1_RISE] + 0.0 * z, 0.0 * z
    more = p[R1_RISE] * np.exp(-z / NEARLY_EMPTY)
    return 1.0 + more, -more / NEARLY_EMPTY


@jit
def advance(z, v1, celsius, i, inflow, keep, capacity, r0, p, dt):
    """Return z, V1 and T of one cell after `dt`; `inflow` W come from outside, `keep` = exp(-dt / τ1)."""
    g, _ = warmth(celsius, p)
    more, _ = rise(z, p)
    return (
        z - i * dt / (3600.0 * capacity),
        keep * v1 + (1.0 - keep) * p[R1] * g * more * i,
        celsius + dt / p[HEAT_CAPACITY] * (i * (r0 * g * i + v1) + inflow),
    )


def f(x, u, p, dt, out):
    """Advance the cell."""
    inflow = (u[AIR] - x[TEMPERATURE]) / p[TO_AIR]
    keep = np.exp(-dt / p[TAU_1])
    out[0], out[1], out[2] = advance(x[0], x[1], x[2], u[CURRENT], inflow, keep, p[CAPACITY], p[R0], p, dt)


@jit
def advance_slope(z, celsius, i, outflow, keep, r0, p, dt, at, out):
    """Fill the derivative of `advance` by its own cell, at `at` on the diagonal; `outflow` in W/K."""
    g, of_g = warmth(celsius, p)
    more, of_more = rise(z, p)
    push = (1.0 - keep) * p[R1] * i
    rate = dt / p[HEAT_CAPACITY]
    out[at, at] = 1.0
    out[at + 1, at] = push * g * of_more
    out[at + 1, at + 1] = keep
    out[at + 1, at + 2] = push * of_g * more
    out[at + 2, at + 1] = rate * i
    out[at + 2, at + 2] = 1.0 + rate * (i * i * r0 * of_g - outflow)


def F(x, u, p, dt, out):
    """Fill the derivative of the step."""
    out[:] = 0.0
    keep = np.exp(-dt / p[TAU_1])
    advance_slope(x[SOC], x[TEMPERATURE], u[CURRENT], 1.0 / p[TO_AIR], keep, p[R0], p, dt, 0, out)


def voltage(x, u, p, out):
    """Measure the terminal voltage."""
    g, _ = warmth(x[TEMPERATURE], p)
    rest, _ = open_circuit(x[SOC], p)
    out[0] = rest + p[OCV_ERROR] - x[V1] - p[R0] * g * u[CURRENT]


def voltage_slope(x, u, p, out):
    """Fill its derivative."""
    _, of_g = warmth(x[TEMPERATURE], p)
    _, out[0, SOC] = open_circuit(x[SOC], p)
    out[0, V1] = -1.0
    out[0, TEMPERATURE] = -p[R0] * of_g * u[CURRENT]


def temperature(x, u, p, out):
    """Measure the temperature of the can."""
    out[0] = x[TEMPERATURE]


def temperature_slope(x, u, p, out):
    """Fill its derivative."""
    out[0, :] = 0.0
    out[0, TEMPERATURE] = 1.0


BATTERY_CELL = StateSpaceModel(
    name="battery_cell",
    title="Lithium-ion cell, state of charge and temperature",
    states=(
        State("soc", "1", mean=0.5, std=0.3, limits=(0.0, 1.0)),
        State("v1", "V", mean=0.0, std=0.02),
        State("temperature", "°C", mean=25.0, std=3.0, fitted=TEMPERATURES),
    ),
    inputs=(Input("current", "A", fitted=CURRENTS), Input("air", "°C", default=25.0)),
    parameters=(
        *COMMON,
        Parameter("capacity", "A h", 2.9, 0.1, 500.0),
        Parameter("r0", "Ω", 0.0328, 1e-4, 0.5),
        Parameter("ocv_error", "V", 0.0, -0.2, 0.2),
    ),
    noises=(
        Noise("soc", "1/s", variance=1e-10),
        Noise("v1", "V²/s", variance=4e-7),
        Noise("temperature", "°C²/s", variance=1e-4),
    ),
    sensors=(
        Sensor("voltage", (Row("voltage", "V", variance=1e-4),), h=voltage, H=voltage_slope),
        Sensor("temperature", (Row("temperature", "°C", variance=0.04),), h=temperature, H=temperature_slope),
    ),
    f=f,
    F=F,
    max_step=2.0,
    source="Plett (2004), doi:10.1016/j.jpowsour.2004.02.032",
)
