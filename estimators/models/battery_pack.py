"""Eight cells in series, each as in `battery_cell`, beside each other in a row: 24 states.

    m dT_k/dt = i (R0_k g(T_k) i + V1_k) - (T_k - T_air) / R_air - Σ (T_k - T_j) / R_neighbour

over the one or two neighbours j of cell k. Capacity and R0 are each cell's own, so a weak cell can be set, simulated,
or estimated; the other parameters are common. One current flows through all; what differs is charge, and so voltage.

Source: Plett (2004), doi:10.1016/j.jpowsour.2004.02.032, cell by cell.
"""

from __future__ import annotations

import numpy as np

from ..model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from ..numerics.jit import jit
from .battery_cell import (
    AIR,
    BATTERY_CELL,
    COMMON,
    CURRENT,
    CURRENTS,
    HEAT_CAPACITY,
    SOC,
    TAU_1,
    TEMPERATURE,
    TEMPERATURES,
    TO_AIR,
    V1,
    advance,
    advance_slope,
    open_circuit,
    warmth,
)

CELLS = 8


NEIGHBOUR = len(COMMON)


CAPACITY = NEIGHBOUR + 1


R0 = CAPACITY + CELLS  # Index of the parameters of the first cell; those of the others follow


NUMBERS = range(1, CELLS + 1)


@jit
def inflow(k, x, u, p):
    """Return the heat that flows into cell k from air and neighbours, W."""
    own = x[3 * k + TEMPERATURE]
    heat = (u[AIR] - own) / p[TO_AIR]
    if k > 0:
        heat += (x[3 * k - 3 + TEMPERATURE] - own) / p[NEIGHBOUR]
    if k < CELLS - 1:
        heat += (x[3 * k + 3 + TEMPERATURE] - own) / p[NEIGHBOUR]
    return heat


def f(x, u, p, dt, out):
    """Advance all cells."""
    keep = np.exp(-dt / p[TAU_1])
    for k in range(CELLS):
        j = 3 * k
        heat = inflow(k, x, u, p)
        out[j], out[j + 1], out[j + 2] = advance(
            x[j], x[j + 1], x[j + 2], u[CURRENT], heat, keep, p[CAPACITY + k], p[R0 + k], p, dt
        )


def F(x, u, p, dt, out):
    """Fill the derivative of the step: a block per cell, and the neighbours' temperatures."""
    out[:] = 0.0
    keep = np.exp(-dt / p[TAU_1])
    share = dt / (p[HEAT_CAPACITY] * p[NEIGHBOUR])
    for k in range(CELLS):
        j = 3 * k
        outflow = 1.0 / p[TO_AIR]
        if k > 0:
            outflow += 1.0 / p[NEIGHBOUR]
            out[j + TEMPERATURE, j - 3 + TEMPERATURE] = share
        if k < CELLS - 1:
            outflow += 1.0 / p[NEIGHBOUR]
            out[j + TEMPERATURE, j + 3 + TEMPERATURE] = share
        advance_slope(x[j], x[j + TEMPERATURE], u[CURRENT], outflow, keep, p[R0 + k], p, dt, j, out)


def Q(x, u, p, q, dt, out):
    """Fill Q: the same noise in every cell."""
    for j in range(x.size):
        out[j, j] = q[j % 3] * dt


def voltages(x, u, p, out):
    """Measure the terminal voltages."""
    for k in range(CELLS):
        g, _ = warmth(x[3 * k + TEMPERATURE], p)
        rest, _ = open_circuit(x[3 * k + SOC], p)
        out[k] = rest - x[3 * k + V1] - p[R0 + k] * g * u[CURRENT]


def voltages_slope(x, u, p, out):
    """Fill their derivatives."""
    out[:] = 0.0
    for k in range(CELLS):
        _, of_g = warmth(x[3 * k + TEMPERATURE], p)
        _, out[k, 3 * k + SOC] = open_circuit(x[3 * k + SOC], p)
        out[k, 3 * k + V1] = -1.0
        out[k, 3 * k + TEMPERATURE] = -p[R0 + k] * of_g * u[CURRENT]


def temperatures(x, u, p, out):
    """Measure the temperature of each can."""
    for k in range(CELLS):
        out[k] = x[3 * k + TEMPERATURE]


def temperatures_slope(x, u, p, out):
    """Fill their derivatives."""
    out[:] = 0.0
    for k in range(CELLS):
        out[k, 3 * k + TEMPERATURE] = 1.0


_capacity, _r0 = BATTERY_CELL.parameters[NEIGHBOUR : NEIGHBOUR + 2]


BATTERY_PACK = StateSpaceModel(
    name="battery_pack",
    title="Eight lithium-ion cells in series, states of charge and temperatures",
    states=tuple(
        state
        for k in NUMBERS
        for state in (
            State(f"soc_{k}", "1", mean=0.8, std=0.1, limits=(0.0, 1.0)),
            State(f"v1_{k}", "V", mean=0.0, std=0.02),
            State(f"temperature_{k}", "°C", mean=25.0, std=3.0, fitted=TEMPERATURES),
        )
    ),
    inputs=(Input("current", "A", fitted=CURRENTS), Input("air", "°C", default=25.0)),
    parameters=(
        *COMMON,
        Parameter("to_neighbour", "K/W", 5.0, 0.1, 1e3),
        *(Parameter(f"capacity_{k}", "A h", _capacity.value, _capacity.low, _capacity.high) for k in NUMBERS),
        *(Parameter(f"r0_{k}", "Ω", _r0.value, _r0.low, _r0.high) for k in NUMBERS),
    ),
    noises=(
        Noise("soc", "1/s", variance=1e-10),
        Noise("v1", "V²/s", variance=1e-8),
        Noise("temperature", "°C²/s", variance=1e-4),
    ),
    sensors=(
        Sensor(
            "voltage",
            tuple(Row(f"cell_{k}", "V", variance=4e-6) for k in NUMBERS),
            h=voltages,
            H=voltages_slope,
        ),
        Sensor(
            "temperature",
            tuple(Row(f"cell_{k}", "°C", variance=0.25) for k in NUMBERS),
            h=temperatures,
            H=temperatures_slope,
        ),
    ),
    f=f,
    F=F,
    Q=Q,
    max_step=2.0,
    source="Plett (2004), doi:10.1016/j.jpowsour.2004.02.032",
)
