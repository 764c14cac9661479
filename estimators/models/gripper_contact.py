"""A gripper's finger and an object in front of it: contact is a mode that no sensor measures.

    depth'   = speed                                distance of the finger past the object's surface; negative before it
    speed'   = (drive - b speed - c k depth) / m    c = 0 apart, 1 touching: a soft pad of stiffness k
    surface' = 0, offset' = 0                       place of the object; offset of the force sensor
    position = surface + depth,   force = c k depth + offset

Apart, the finger comes to touch at the rate λ / (1 + exp(-depth/w)); touching, it lets go at λ / (1 + exp(depth/w)):
a rough surface of width w, which sticks a little when the finger leaves. An object that slips moves surface and depth
against each other.

Given depth and contact, all is linear in speed, surface and offset: a particle needs two numbers, not five. The
surface is known to some millimetres only, so that the absence of contact is information.

Source: the spring and damper of Hertz-like contact in one dimension, as in Siciliano et al. (2009), Robotics:
Modelling, Planning and Control, section 9.1.3 (contact force from an elastic environment); contact as a jump of a
Markov mode as in Doucet, Gordon & Krishnamurthy (2001), doi:10.1109/78.905890; numbers of our own.
"""

from __future__ import annotations

import numpy as np

from ..model.state_space import Input, Jump, Noise, Parameter, Row, Sensor, State, StateSpaceModel

CONTACT, DEPTH, SPEED, SURFACE, OFFSET = range(5)


MASS, DAMPING, STIFFNESS, RATE, ROUGHNESS = range(5)


PUSH, SLIP, DRIFT = range(3)


MILLI = 1000.0  # mm in a metre: forces are in N, masses in kg, lengths in mm


def f(x, u, p, dt, out):
    """Advance the speed, then the depth with the new speed: stable while the pad is soft for the step."""
    pull = u[0] - p[DAMPING] * x[SPEED] - x[CONTACT] * p[STIFFNESS] * x[DEPTH]
    out[SPEED] = x[SPEED] + dt * MILLI / p[MASS] * pull
    out[DEPTH] = x[DEPTH] + dt * out[SPEED]
    out[SURFACE] = x[SURFACE]
    out[OFFSET] = x[OFFSET]
    out[CONTACT] = x[CONTACT]


def F(x, u, p, dt, out):
    """Fill its Jacobian."""
    out[:] = 0.0
    a = dt * MILLI / p[MASS]
    out[SPEED, SPEED] = 1.0 - a * p[DAMPING]
    out[SPEED, DEPTH] = -a * x[CONTACT] * p[STIFFNESS]
    out[SPEED, CONTACT] = -a * p[STIFFNESS] * x[DEPTH]
    for j in range(5):
        out[DEPTH, j] = dt * out[SPEED, j]
    out[DEPTH, DEPTH] += 1.0
    out[SURFACE, SURFACE] = 1.0
    out[OFFSET, OFFSET] = 1.0
    out[CONTACT, CONTACT] = 1.0


def Q(x, u, p, q, dt, out):
    """Fill Q: pushes change the speed; an object that slips away is farther off and less deep."""
    out[SPEED, SPEED] = q[PUSH] * dt
    out[SURFACE, SURFACE] = q[SLIP] * dt
    out[DEPTH, DEPTH] = q[SLIP] * dt
    out[SURFACE, DEPTH] = -q[SLIP] * dt
    out[DEPTH, SURFACE] = -q[SLIP] * dt
    out[OFFSET, OFFSET] = q[DRIFT] * dt


def chances(x, u, p, dt, out):
    """Fill the probabilities of the modes after dt at the rates λ/(1 + exp(∓depth/w))."""
    inside = 1.0 / (1.0 + np.exp(-x[DEPTH] / p[ROUGHNESS]))
    touch = 1.0 - np.exp(-p[RATE] * dt * inside)
    leave = 1.0 - np.exp(-p[RATE] * dt * (1.0 - inside))
    out[1] = touch + x[CONTACT] * (1.0 - leave - touch)
    out[0] = 1.0 - out[1]


def position(x, u, p, out):
    """Measure the position with the encoder."""
    out[0] = x[SURFACE] + x[DEPTH]


def position_slopes(x, u, p, out):
    """Fill its Jacobian."""
    out[:] = 0.0
    out[0, SURFACE] = 1.0
    out[0, DEPTH] = 1.0


def force(x, u, p, out):
    """Measure the pad's force, with the sensor's offset."""
    out[0] = x[CONTACT] * p[STIFFNESS] * x[DEPTH] + x[OFFSET]


def force_slopes(x, u, p, out):
    """Fill its Jacobian."""
    out[:] = 0.0
    out[0, DEPTH] = x[CONTACT] * p[STIFFNESS]
    out[0, OFFSET] = 1.0
    out[0, CONTACT] = p[STIFFNESS] * x[DEPTH]


GRIPPER_CONTACT = StateSpaceModel(
    name="gripper_contact",
    title="Gripper, finger and object touching or not",
    states=(
        State("contact", "1", mean=0.02, std=0.14),
        State("depth", "mm", mean=-20.0, std=5.0),
        State("speed", "mm/s", std=5.0),
        State("surface", "mm", mean=40.0, std=5.0),
        State("offset", "N", std=0.3),
    ),
    inputs=(Input("drive", "N"),),
    parameters=(
        Parameter("mass", "kg", 0.5, low=0.05, high=5.0),
        Parameter("damping", "N s/mm", 0.01, low=0.001, high=0.05),
        Parameter("stiffness", "N/mm", 0.5, low=0.05, high=2.0),
        Parameter("rate", "1/s", 50.0, low=1.0, high=500.0),
        Parameter("roughness", "mm", 0.2, low=0.01, high=5.0),
    ),
    noises=(
        Noise("push", "(mm/s)²/s", variance=100.0),
        Noise("slip", "mm²/s", variance=0.02),
        Noise("drift", "N²/s", variance=1e-4),
    ),
    sensors=(
        Sensor("position", (Row("position", "mm", variance=0.04),), h=position, H=position_slopes),
        Sensor("force", (Row("force", "N", variance=0.0225),), h=force, H=force_slopes),
    ),
    f=f,
    F=F,
    Q=Q,
    jump=Jump("contact", ("apart", "touching"), chances),
    conditionally_linear=("speed", "surface", "offset"),
    max_step=0.01,
    source="a finger of our own; Doucet, Gordon & Krishnamurthy (2001), doi:10.1109/78.905890, for the mode that jumps",
)
