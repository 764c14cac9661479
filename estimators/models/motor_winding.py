"""A motor winding's temperature and heating rate, as a constant-velocity model.

T' = T + dt·rate,  rate' = rate,  y = T + v. The process noise is a random walk on each state.
"""

from __future__ import annotations

from ..model.state_space import Noise, Row, Sensor, State, StateSpaceModel


def f(x, u, p, dt, out):
    """The temperature grows by its rate; the rate stays."""
    out[0] = x[0] + dt * x[1]
    out[1] = x[1]


def winding(x, u, p, out):
    """The thermometer in the winding."""
    out[0] = x[0]


MOTOR_WINDING = StateSpaceModel(
    name="motor_winding",
    title="Motor winding, temperature and heating rate",
    states=(
        State("temperature", "°C", mean=35.0, std=5.0),
        State("rate", "°C/s", mean=0.0, std=1.0),
    ),
    noises=(
        Noise("temperature", "°C²/s", variance=0.01),
        Noise("rate", "°C²/s³", variance=0.001),
    ),
    sensors=(Sensor("winding", (Row("winding", "°C", variance=4.0),), h=winding),),
    f=f,
    linear=True,
    source="digital-twin state estimation example: winding temperature and rate, Q = diag(0.01, 0.001), R = 4",
)
