"""A vehicle in a corridor with a two-fold symmetry, broken only by a door: four range finders and odometry.

    east' = speed cos ψ,   north' = speed sin ψ,   ψ' = yaw_rate
    scan_k = distance along ψ + k π/2 to the first wall,   k = 0 ahead, 1 left, 2 behind, 3 right

The building is a rectilinear polygon about the origin, 48 m long and 3 m wide, with an alcove to the north and one to
the south. (east, north, ψ) and (-east, -north, ψ + π) give the same ranges, unless a beam meets the door, a niche in
the north wall: until then the true posterior has two peaks. The prior is one Gaussian over the whole building and all
headings.

Each wall is parallel to an axis, so a beam's distance is a quotient, d = (wall - east) / cos ψ, with the slopes
-1 / cos ψ and d tan ψ: the Jacobian is exact wherever a beam does not meet a corner.

Source: Thrun, Burgard & Fox (2005), Probabilistic Robotics, sections 6.3 (beams) and 8.3 (particles).
"""

from __future__ import annotations

import numpy as np

from ..model.state_space import Input, Noise, Row, Sensor, State, StateSpaceModel
from ..numerics.jit import jit

EAST, NORTH, HEADING = range(3)


SPEED, YAW_RATE = range(2)


FAR = 60.0  # Range of a beam that meets no wall, m; only from outside the building


OUTLINE = (
    (-24.0, -1.5), (-12.0, -1.5), (-12.0, -3.0), (-10.0, -3.0), (-10.0, -1.5), (24.0, -1.5),
    (24.0, 1.5), (12.0, 1.5), (12.0, 3.0), (10.0, 3.0), (10.0, 1.5),
    (-4.0, 1.5), (-4.0, 3.0), (-5.2, 3.0), (-5.2, 1.5), (-24.0, 1.5),
)  # fmt: skip
"""Corners of the building, m; the short niche to the north is the door."""


WALLS = np.array([(*a, *b) for a, b in zip(OUTLINE, OUTLINE[1:] + OUTLINE[:1], strict=True)])
"""East and north of both ends of each wall, (16, 4)."""


@jit
def first_wall(east, north, c, s):
    """Return the distance along (c, s) to the first wall, and its slopes by east, north and the direction's angle."""
    best, by_east, by_north, by_angle = FAR, 0.0, 0.0, 0.0
    for k in range(WALLS.shape[0]):
        a_east, a_north, b_east, b_north = WALLS[k, 0], WALLS[k, 1], WALLS[k, 2], WALLS[k, 3]
        if a_east == b_east:
            if c == 0.0:
                continue
            d = (a_east - east) / c
            at = north + d * s
            if 0.0 <= d < best and min(a_north, b_north) <= at <= max(a_north, b_north):
                best, by_east, by_north, by_angle = d, -1.0 / c, 0.0, d * s / c
        else:
            if s == 0.0:
                continue
            d = (a_north - north) / s
            at = east + d * c
            if 0.0 <= d < best and min(a_east, b_east) <= at <= max(a_east, b_east):
                best, by_east, by_north, by_angle = d, 0.0, -1.0 / s, -d * c / s
    return best, by_east, by_north, by_angle


def f(x, u, p, dt, out):
    """Drive with the heading at the middle of the step."""
    middle = x[HEADING] + 0.5 * dt * u[YAW_RATE]
    out[EAST] = x[EAST] + dt * u[SPEED] * np.cos(middle)
    out[NORTH] = x[NORTH] + dt * u[SPEED] * np.sin(middle)
    out[HEADING] = x[HEADING] + dt * u[YAW_RATE]


def Q(x, u, p, q, dt, out):
    """Fill Q: the same noise for east and north."""
    out[EAST, EAST] = q[0] * dt
    out[NORTH, NORTH] = q[0] * dt
    out[HEADING, HEADING] = q[1] * dt


def scan(x, u, p, out):
    """Measure the four distances."""
    c, s = np.cos(x[HEADING]), np.sin(x[HEADING])
    for k in range(4):
        out[k] = first_wall(x[EAST], x[NORTH], c, s)[0]
        c, s = -s, c


def scan_slopes(x, u, p, out):
    """Fill their Jacobian."""
    c, s = np.cos(x[HEADING]), np.sin(x[HEADING])
    for k in range(4):
        _, out[k, EAST], out[k, NORTH], out[k, HEADING] = first_wall(x[EAST], x[NORTH], c, s)
        c, s = -s, c


AGV_CORRIDOR = StateSpaceModel(
    name="agv_corridor",
    title="Vehicle in a corridor that half a turn leaves the same, ranges and odometry",
    states=(
        State("east", "m", std=12.0),
        State("north", "m", std=0.6),
        State("heading", "rad", std=3.0, circular=True),
    ),
    inputs=(Input("speed", "m/s"), Input("yaw_rate", "rad/s")),
    noises=(Noise("position", "m²/s", variance=0.01), Noise("heading", "rad²/s", variance=0.002)),
    sensors=(
        Sensor(
            "scan",
            tuple(Row(name, "m", variance=0.25) for name in ("ahead", "left", "behind", "right")),
            h=scan,
            H=scan_slopes,
        ),
    ),
    f=f,
    Q=Q,
    max_step=0.25,
    source="Thrun, Burgard & Fox (2005), Probabilistic Robotics, sections 6.3 and 8.3; a building of our own",
)
