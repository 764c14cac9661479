"""A road car on a plane: position, heading, speed, the errors of its inertial sensors and of its wheel speed.

    east'  = v cos ψ,   north' = v sin ψ        a = accel - accel_bias
    ψ'     = yaw_rate - yaw_rate_bias           v' = a

Forward acceleration and yaw rate are inputs, as is usual in inertial navigation: their noise is process noise, and
their slowly moving errors (road grade and mounting are in the first) are states. Heading ψ is counted from east to the
left, as in ISO 8855; a compass heading χ is ψ = 90° - χ. A wheel sensor measures wheel_scale·v. A GNSS receiver
measures the position `gnss_delay` seconds ago. Its error wanders slowly: a twin models that with the sensor's `error`,
or a thousand fixes with a common error would count as a thousand independent ones.

Source: Groves (2013), Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd edition, for
inertial errors as states.
"""

from __future__ import annotations

import numpy as np

from ..model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel

EAST, NORTH, HEADING, SPEED, ACCEL_BIAS, YAW_RATE_BIAS, WHEEL_SCALE = range(7)


ACCEL, YAW_RATE = range(2)


GNSS_DELAY = 0


def f(x, u, p, dt, out):
    """Drive with speed and heading at the middle of the step."""
    gained = dt * (u[ACCEL] - x[ACCEL_BIAS])
    turned = dt * (u[YAW_RATE] - x[YAW_RATE_BIAS])
    way = dt * (x[SPEED] + 0.5 * gained)
    middle = x[HEADING] + 0.5 * turned
    out[EAST] = x[EAST] + way * np.cos(middle)
    out[NORTH] = x[NORTH] + way * np.sin(middle)
    out[HEADING] = x[HEADING] + turned
    out[SPEED] = x[SPEED] + gained
    for i in range(ACCEL_BIAS, x.size):
        out[i] = x[i]


def Q(x, u, p, q, dt, out):
    """Fill Q: the same noise for east and north; one entry for each of the other states."""
    out[EAST, EAST] = q[0] * dt
    for k in range(q.size):
        out[NORTH + k, NORTH + k] = q[k] * dt


def gnss_position(x, u, p, out):
    """Measure the position `gnss_delay` ago."""
    back = p[GNSS_DELAY] * x[SPEED]
    out[0] = x[EAST] - back * np.cos(x[HEADING])
    out[1] = x[NORTH] - back * np.sin(x[HEADING])


def gnss_heading(x, u, p, out):
    """Measure the course over ground then; a receiver has it only while the car moves."""
    out[0] = x[HEADING] - p[GNSS_DELAY] * (u[YAW_RATE] - x[YAW_RATE_BIAS])


def gnss_speed(x, u, p, out):
    """Measure the speed over ground then."""
    out[0] = x[SPEED] - p[GNSS_DELAY] * (u[ACCEL] - x[ACCEL_BIAS])


def wheel_speed(x, u, p, out):
    """Measure the speed of the wheels, by OBD or from a brake controller."""
    out[0] = x[WHEEL_SCALE] * x[SPEED]


def second_position(x, u, p, out):
    """Measure with another receiver, whose delay and error are its own: a check when it is held out."""
    out[0] = x[EAST]
    out[1] = x[NORTH]


ROAD_CAR = StateSpaceModel(
    name="road_car",
    title="Road car, position, heading and speed from GNSS, wheels and inertial sensors",
    states=(
        State("east", "m", std=1000.0),
        State("north", "m", std=1000.0),
        State("heading", "rad", std=1.0, circular=True),
        State("speed", "m/s", std=10.0),
        State("accel_bias", "m/s²", std=0.5),
        State("yaw_rate_bias", "rad/s", std=0.01),
        State("wheel_scale", "1", mean=1.0, std=0.02),
    ),
    inputs=(Input("accel", "m/s²"), Input("yaw_rate", "rad/s")),
    parameters=(Parameter("gnss_delay", "s", 0.0, 0.0, 2.0),),
    noises=(
        Noise("position", "m²/s", variance=0.01),
        Noise("heading", "rad²/s", variance=1e-5),
        Noise("speed", "(m/s)²/s", variance=0.05),
        Noise("accel_bias", "(m/s²)²/s", variance=0.01),
        Noise("yaw_rate_bias", "(rad/s)²/s", variance=1e-8),
        Noise("wheel_scale", "1/s", variance=1e-9),
    ),
    sensors=(
        Sensor(
            "gnss_position",
            (Row("east", "m", variance=4.0), Row("north", "m", variance=4.0)),
            h=gnss_position,
        ),
        Sensor("gnss_heading", (Row("heading", "rad", variance=1e-3, circular=True),), h=gnss_heading),
        Sensor("gnss_speed", (Row("speed", "m/s", variance=0.04),), h=gnss_speed),
        Sensor("wheel_speed", (Row("speed", "m/s", variance=0.04),), h=wheel_speed),
        Sensor(
            "second_position",
            (Row("east", "m", variance=25.0), Row("north", "m", variance=25.0)),
            h=second_position,
        ),
    ),
    f=f,
    Q=Q,
    max_step=0.1,
    source="Groves (2013), Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, on a plane",
)
