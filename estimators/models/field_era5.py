"""Air temperature at 2 m over the British Isles, on a grid of a quarter of a degree: fading persistence.

    T' = C + (T - C) exp(-dt / τ) + w

The model has no sun, wind, clouds or coast: T persists, and relaxes within τ towards the season's mean C. Everything
else, the daily cycle too, is noise w, correlated between nearby places. The estimate improves on C by the measurements
at a few places, and by the correlation of the noise in between.

A cell is 0.25° high and wide: 27.8 km from north to south, and from west to east 16.3 km in the middle, at 54° north.
"""

from __future__ import annotations

import numpy as np

from ..model.parts import Field
from ..model.state_space import Noise, Parameter, Row, Sensor, StateSpaceModel
from ..numerics.smoothed_noise import exponential

SPACING = (27.8, 16.3)  # Side of a cell to the south and to the east, km
LENGTH = 400.0  # Correlation length of the noise, km
SHAPE = (33, 49)  # Cells from 58° to 50° north, and from 10° west to 2° east


STATIONS = tuple((i, j) for i in (3, 10, 16, 22, 29) for j in (3, 9, 15, 21, 27, 33, 39, 45))
"""Cells with a thermometer."""


_flat = np.array([i * SHAPE[1] + j for i, j in STATIONS])


def f(T, u, p, dt, out):
    """Persistence that fades."""
    stays = np.exp(-dt / p[1])
    for k in range(out.size):
        out[k] = p[0] + (T[k] - p[0]) * stays


def stations(T, u, p, out):
    """Measure the cells with a thermometer."""
    for k in range(out.size):
        out[k] = T[_flat[k]]


FIELD_ERA5 = StateSpaceModel(
    name="field_era5",
    title="Air temperature over the British Isles",
    states=Field("t2m", "°C", SHAPE, spacing=SPACING, mean=7.5, std=3.0),
    parameters=(
        Parameter("climate", "°C", 7.5, -30.0, 40.0),
        Parameter("relaxation", "s", 172800.0, 3600.0, 1e7),
    ),
    noises=(Noise("t2m", "°C²/s", variance=1e-4),),
    sensors=(
        Sensor(
            "stations",
            tuple(
                Row(f"s{i}_{j}", "°C", variance=0.01, position=(i * SPACING[0], j * SPACING[1])) for i, j in STATIONS
            ),
            h=stations,
        ),
    ),
    f=f,
    shape=exponential(*SHAPE, spacing=SPACING, length=LENGTH),
    source="persistence that fades, a first-order autoregression; no equation of the atmosphere",
)
