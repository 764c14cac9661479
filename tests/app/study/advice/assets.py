"""Eight assets of which it is known how they were made, as models; `recordings.py` makes their recordings."""

import math
from dataclasses import replace

from estimators.model import Field, Input, Noise, Row, Sensor, State, StateSpaceModel
from tests.models import constant_speed, first_state, first_state_squared, level_model, unchanged

CELLS = 1200
EVERY = 40
"""Cells from one probe of the field to the next."""


LINEAR = StateSpaceModel(
    name="linear",
    title="A cart on a rail",
    states=(State("place", "m", std=5.0), State("speed", "m/s", std=1.0)),
    noises=(Noise("place", "m²/s", 0.001), Noise("speed", "m²/s³", 0.01)),
    sensors=(Sensor("rail", (Row("rail", "m", 1.0),), h=first_state),),
    f=constant_speed,
    linear=True,
)


def draining(x, u, p, dt, out):
    """Torricelli's law."""
    out[0] = x[0] + dt * (u[0] - 0.1 * math.sqrt(max(x[0], 0.01)))


MILD = level_model(
    {"gauge": 1e-4}, 1e-5, name="mild", title="A tank that drains", mean=1.0, std=0.05,
    inputs=(Input("inflow", "m/s", 0.1),), f=draining,
)  # fmt: skip


def reverting(x, u, p, dt, out):
    """A first-order lag of 5 s towards zero."""
    out[0] = math.exp(-dt / 5.0) * x[0]


def exponential(x, u, p, out):
    """What hardly moves where x is low and runs away where it is high."""
    out[0] = math.exp(x[0])


STRONG = StateSpaceModel(
    name="strong",
    title="A sensor that reads the exponential",
    states=(State("x", "1", std=1.0),),
    noises=(Noise("x", "1/s", 0.4),),
    sensors=(Sensor("glow", (Row("glow", "1", 0.25),), h=exponential),),
    f=reverting,
)


STILL = level_model({"float": 1.0}, 1e-6, name="still", title="A level that hardly changes", std=3.0, linear=True)


PEAKS = StateSpaceModel(
    name="peaks",
    title="A sensor that cannot tell left from right",
    states=(State("x", "m", std=4.0),),
    noises=(Noise("x", "m²/s", 0.01),),
    sensors=(Sensor("distance", (Row("distance", "m²", 4.0),), h=first_state_squared),),
    f=unchanged,
)


def spreading(x, u, p, dt, out):
    """Warmth that flows along a ring and between neighbours; steps are one second or less."""
    n = x.size
    for k in range(n):
        before, after = x[(k - 1) % n], x[(k + 1) % n]
        out[k] = x[k] + dt * (0.4 * (before - x[k]) + 0.1 * (before - 2.0 * x[k] + after))


def probes(x, u, p, out):
    """Every 40th cell."""
    for k in range(out.size):
        out[k] = x[k * EVERY]


def smooth(z, p, out):
    """Noise that is alike over ten cells: a running mean, of unit variance."""
    n = z.size
    total = 0.0
    for k in range(10):
        total += z[k]
    for k in range(n):
        out[k] = total / math.sqrt(10.0)
        total += z[(k + 10) % n] - z[k]


FIELD = StateSpaceModel(
    name="field",
    title="A ring of warm water",
    states=Field("warmth", "K", (CELLS,), spacing=1.0, periodic=(True,), std=1.0),
    noises=(Noise("warmth", "K²/s", 0.05),),
    sensors=(
        Sensor(
            "probes", tuple(Row(f"p{k}", "K", 0.04, position=(float(k),)) for k in range(0, CELLS, EVERY)), h=probes
        ),
    ),
    f=spreading,
    shape=smooth,
    linear=True,
    max_step=1.0,
)


def with_load(x, u, p, dt, out):
    """A cart, and a load that moves nothing."""
    out[0] = x[0] + dt * x[1]
    out[1] = x[1]
    out[2] = x[2]


UNSEEN = replace(
    LINEAR,
    name="unseen",
    title="A cart with a load that nothing tells of",
    states=(*LINEAR.states, State("load", "kg", mean=10.0, std=3.0)),
    noises=(*LINEAR.noises, Noise("load", "kg²/s", 1e-4)),
    f=with_load,
)


def cooled(x, u, p, dt, out):
    """A body cooled by a flow that is known: linear in the temperature, and never the same."""
    out[0] = math.exp(-dt * u[0]) * x[0]


VARYING = StateSpaceModel(
    name="varying",
    title="A body in a flow that changes",
    states=(State("excess", "K", mean=10.0, std=5.0),),
    inputs=(Input("flow", "1/s", 0.1),),
    noises=(Noise("excess", "K²/s", 0.5),),
    sensors=(Sensor("probe", (Row("probe", "K", 0.25),), h=first_state),),
    f=cooled,
    linear=True,
)
