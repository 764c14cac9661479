"""A heated plate: conduction on a grid of cells, a source that moves over it, thermocouples far apart.

    dT/dt = α ∇²T - (T - T_ambient) / τ + q exp(-|r - r_source|² / (2 w²))

by finite volumes with insulated edges and one explicit step, stable up to a step of spacing² / (4 α). Cell (i, j) is at
(i, j)·spacing. The position of the source is an input, its strength is uncertain: the noise, correlated over 0.1 m,
stands for that.

Source: Patankar (1980), Numerical Heat Transfer and Fluid Flow, sections 4.2 to 4.4; α of carbon steel.
"""

from __future__ import annotations

import numpy as np

from ..model.parts import Field
from ..model.state_space import Input, Noise, Parameter, Row, Sensor, StateSpaceModel
from ..numerics.jit import jit
from ..numerics.smoothed_noise import exponential

SPACING = 0.01  # Side of a cell, m
CORRELATED = 0.1  # Correlation length of the noise, m


@jit
def conduct(T, rows, columns, u, p, dt, out):
    """Take one explicit step of all cells."""
    diffusivity, relaxation, heating, width = p[0], p[1], p[2], p[3]
    a = dt * diffusivity / (SPACING * SPACING)
    loss = dt / relaxation
    ambient = u[2]
    for i in range(rows):
        here = i * columns
        above = here - columns if i > 0 else here
        below = here + columns if i < rows - 1 else here
        last = columns - 1
        for j in range(1, last):
            t = T[here + j]
            around = T[above + j] + T[below + j] + T[here + j - 1] + T[here + j + 1]
            out[here + j] = t + a * (around - 4.0 * t) - loss * (t - ambient)
        for j in (0, last):
            t = T[here + j]
            left = T[here + max(j - 1, 0)]
            right = T[here + min(j + 1, last)]
            around = T[above + j] + T[below + j] + left + right
            out[here + j] = t + a * (around - 4.0 * t) - loss * (t - ambient)
    # The source acts within four of its widths.
    reach = int(4.0 * width / SPACING) + 1
    at_i, at_j = int(u[0] / SPACING), int(u[1] / SPACING)
    for i in range(max(0, at_i - reach), min(rows, at_i + reach + 1)):
        for j in range(max(0, at_j - reach), min(columns, at_j + reach + 1)):
            square = (i * SPACING - u[0]) ** 2 + (j * SPACING - u[1]) ** 2
            out[i * columns + j] += dt * heating * np.exp(-0.5 * square / (width * width))


def thermal_field(rows: int = 200, columns: int = 200, sensors: int = 10, name: str = "") -> StateSpaceModel:
    """Return the model on a grid of rows × columns, with sensors × sensors thermocouples evenly spread.

    `rows` and `columns` from 2 on; `sensors` no more than either.
    """
    at_i = np.linspace(0, rows, sensors, endpoint=False) + rows / (2 * sensors)
    at_j = np.linspace(0, columns, sensors, endpoint=False) + columns / (2 * sensors)
    cells = [(int(i), int(j)) for i in at_i for j in at_j]
    flat = np.array([i * columns + j for i, j in cells])

    def f(T, u, p, dt, out):  # noqa: ANN001, ANN202
        conduct(T, rows, columns, u, p, dt, out)

    def thermocouples(T, u, p, out):  # noqa: ANN001, ANN202
        for k in range(out.size):
            out[k] = T[flat[k]]

    return StateSpaceModel(
        name=name or f"thermal_field_{rows}x{columns}",
        title=f"Heated plate, {rows} × {columns} cells",
        states=Field("temperature", "°C", (rows, columns), spacing=SPACING, mean=20.0, std=1.0),
        inputs=(
            Input("source_x", "m", 0.5 * rows * SPACING),
            Input("source_y", "m", 0.5 * columns * SPACING),
            Input("ambient", "°C", 20.0),
        ),
        parameters=(
            Parameter("diffusivity", "m²/s", 1.2e-5, 0.0, 2.4e-5),
            Parameter("relaxation", "s", 1800.0, 10.0, 1e6),
            Parameter("heating", "K/s", 2.0, 0.0, 100.0),
            Parameter("width", "m", 0.05, 0.005, 1.0),
        ),
        noises=(Noise("temperature", "°C²/s", variance=0.01),),
        sensors=(
            Sensor(
                "thermocouples",
                tuple(Row(f"t{i}_{j}", "°C", variance=0.25, position=(i * SPACING, j * SPACING)) for i, j in cells),
                h=thermocouples,
            ),
        ),
        f=f,
        shape=exponential(rows, columns, spacing=SPACING, length=CORRELATED),
        max_step=1.0,
        source="Patankar (1980), Numerical Heat Transfer and Fluid Flow, sections 4.2 to 4.4",
    )


THERMAL_FIELD = thermal_field(name="thermal_field")


THERMAL_FIELD_LARGE = thermal_field(1000, 1000, name="thermal_field_large")
