"""A model once for one state and once as a black box, of plain arithmetic, so that both round alike."""

from dataclasses import replace

import numpy as np

from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from tests.models import second_state


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * x[1]
    out[1] = x[1] + dt * (u[0] - p[0] * x[0] * x[0] * x[0] - p[1] * x[1])


def both(x, u, p, out):
    out[0] = x[0] * x[0] + x[1]
    out[1] = x[1] - u[0]


def f_block(X, u, p, dt):
    x, v = X[:, 0], X[:, 1]
    return np.stack((x + dt * v, v + dt * (u[0] - p[0] * x * x * x - p[1] * v)), axis=1)


def both_block(X, u, p):
    return np.stack((X[:, 0] * X[:, 0] + X[:, 1], X[:, 1] - u[0]), axis=1)


def speed_block(X, u, p):
    return X[:, 1:]


ONE = StateSpaceModel(
    name="duffing",
    title="hardening spring",
    states=(State("x", "m", 0.4, 0.5), State("v", "m/s", -0.2, 0.4)),
    inputs=(Input("force", "N", 0.1),),
    parameters=(Parameter("cubic", "1", 0.7), Parameter("damping", "1", 0.2)),
    noises=(Noise("x", "m²/s", 0.01), Noise("v", "m²/s³", 0.03)),
    sensors=(
        Sensor("both", (Row("a", "1", 0.05), Row("b", "m/s", 0.2)), h=both),
        Sensor("speed", (Row("speed", "m/s", 0.1),), h=second_state),
    ),
    f=f,
    max_step=0.15,
)
BOX = replace(
    ONE,
    f=f_block,
    sensors=tuple(replace(s, h=h) for s, h in zip(ONE.sensors, (both_block, speed_block), strict=True)),
    black_box=True,
)
