"""A rover on a plane with odometry that measures its distance to fixed radio anchors, one at a time.

    east'  = v cos ψ,   north' = v sin ψ,   ψ' = ω - yaw_rate_bias
    v = odometry_scale (speed + (right + left) / 2),   ω = yaw_rate + (right - left) / track
    range_i = range_scale · |position - anchor_i| + bias_i

The odometry is an input: either speed and yaw rate, or the speeds of the wheels of a differential drive; inputs that a
recording does not have stay zero. Heading ψ is counted from east to the left. A radio that reflects off a wall instead
of crossing it arrives late, so each anchor has a bias with a correlation time,

    bias_i' = (reflection - bias_i) / bias_time + w,    so bias_i settles at reflection ± √(Q.bias · bias_time / 2)

The positions of the anchors are parameters, set in the twin's YAML; they can be estimated (`role: estimated`).

Sources: Thrun, Burgard & Fox (2005), Probabilistic Robotics, section 5.4, for the odometry; Djugash, Hamner & Roth
(2009), doi:10.1002/rob.20311, for ranges whose errors grow with the distance.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel

EAST, NORTH, HEADING, YAW_RATE_BIAS, RANGE_SCALE, BIAS = range(6)


SPEED, YAW_RATE, RIGHT, LEFT = range(4)


ODOMETRY_SCALE, TRACK, BIAS_TIME, REFLECTION, ANCHOR = range(5)


def f(x, u, p, dt, out):
    """Drive with the heading at the middle of the step; its sub-steps are short."""
    way = dt * p[ODOMETRY_SCALE] * (u[SPEED] + 0.5 * (u[RIGHT] + u[LEFT]))
    turned = dt * (u[YAW_RATE] + (u[RIGHT] - u[LEFT]) / p[TRACK] - x[YAW_RATE_BIAS])
    middle = x[HEADING] + 0.5 * turned
    out[EAST] = x[EAST] + way * np.cos(middle)
    out[NORTH] = x[NORTH] + way * np.sin(middle)
    out[HEADING] = x[HEADING] + turned
    out[YAW_RATE_BIAS] = x[YAW_RATE_BIAS]
    out[RANGE_SCALE] = x[RANGE_SCALE]
    kept = np.exp(-dt / p[BIAS_TIME])
    for i in range(BIAS, x.size):
        out[i] = p[REFLECTION] + kept * (x[i] - p[REFLECTION])


def Q(x, u, p, q, dt, out):
    """Fill Q: the same noise for east and north, and for all biases."""
    out[EAST, EAST] = q[0] * dt
    for k in range(4):
        out[NORTH + k, NORTH + k] = q[k] * dt
    wandered = 0.5 * q[4] * p[BIAS_TIME] * (1.0 - np.exp(-2.0 * dt / p[BIAS_TIME]))
    for i in range(BIAS, x.size):
        out[i, i] = wandered


def range_to(anchor: int) -> Callable:
    """Return h of the range to one anchor, counted from 0."""

    def h(x, u, p, out):
        east = x[EAST] - p[ANCHOR + 2 * anchor]
        north = x[NORTH] - p[ANCHOR + 2 * anchor + 1]
        out[0] = x[RANGE_SCALE] * np.sqrt(east * east + north * north) + x[BIAS + anchor]

    return h


def uwb_rover(anchors: int = 4) -> StateSpaceModel:
    """Return the rover with so many anchors, which are numbered from 1."""
    numbers = range(1, anchors + 1)
    corners = [(10.0 * np.cos(2 * np.pi * k / anchors), 10.0 * np.sin(2 * np.pi * k / anchors)) for k in range(anchors)]
    return StateSpaceModel(
        name="uwb_rover",
        title="Rover on a plane, ranges to radio anchors and odometry",
        states=(
            State("east", "m", std=10.0),
            State("north", "m", std=10.0),
            State("heading", "rad", std=1.0, circular=True),
            State("yaw_rate_bias", "rad/s", std=0.01),
            State("range_scale", "1", mean=1.0, std=0.05),
            *(State(f"bias_{k}", "m", std=0.3) for k in numbers),
        ),
        inputs=(
            Input("speed", "m/s"),
            Input("yaw_rate", "rad/s"),
            Input("right", "m/s"),
            Input("left", "m/s"),
        ),
        parameters=(
            Parameter("odometry_scale", "1", 1.0, 0.5, 2.0),
            Parameter("track", "m", 0.5, 0.01, 10.0),
            Parameter("bias_time", "s", 10.0, 0.1, 10e3),
            Parameter("reflection", "m", 0.0, 0.0, 10.0),
            *(
                Parameter(f"anchor_{k}_{axis}", "m", round(float(place), 3), -1e6, 1e6)
                for k, corner in zip(numbers, corners, strict=True)
                for axis, place in zip(("east", "north"), corner, strict=True)
            ),
        ),
        noises=(
            Noise("position", "m²/s", variance=0.01),
            Noise("heading", "rad²/s", variance=1e-4),
            Noise("yaw_rate_bias", "(rad/s)²/s", variance=1e-8),
            Noise("range_scale", "1/s", variance=1e-8),
            Noise("bias", "m²/s", variance=0.01),
        ),
        sensors=tuple(
            Sensor(f"range_{k}", (Row("range", "m", variance=0.04),), h=range_to(k - 1), family="range")
            for k in numbers
        ),
        f=f,
        Q=Q,
        max_step=0.25,
        source="Thrun, Burgard & Fox (2005), Probabilistic Robotics, section 5.4, with ranges to anchors",
    )


UWB_ROVER = uwb_rover()
