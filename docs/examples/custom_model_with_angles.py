"""A model of your own with a circular state: heading of a boat from a rate gyro and a compass.

The heading crosses ±π several times. Because state and compass are declared `circular`, innovations are computed on the
circle: an estimate of 179° and a measurement of -179° differ by 2°.

Run: python docs/examples/custom_model_with_angles.py
"""

import math

import numpy as np

from nisus import Log, Noise, Row, Sensor, State, StateSpaceModel, fold


def turn(x, u, p, dt, out):
    """Heading, turn rate and gyro bias, dt seconds later."""
    out[0] = x[0] + dt * x[1]
    out[1] = x[1]
    out[2] = x[2]


def compass(x, u, p, out):
    """Heading, rad."""
    out[0] = x[0]


def gyro(x, u, p, out):
    """Turn rate plus bias, rad/s."""
    out[0] = x[1] + x[2]


BOAT = StateSpaceModel(
    name="boat",
    title="Heading of a boat",
    states=(
        State("heading", "rad", mean=0.0, std=3.0, circular=True),
        State("rate", "rad/s", mean=0.0, std=0.2),
        State("bias", "rad/s", mean=0.0, std=0.05),
    ),
    noises=(
        Noise("heading", "rad²/s", variance=1e-6),
        Noise("rate", "rad²/s³", variance=1e-3),
        Noise("bias", "rad²/s³", variance=1e-8),
    ),
    sensors=(
        Sensor("compass", (Row("heading", "rad", variance=0.1**2, circular=True),), h=compass),
        Sensor("gyro", (Row("rate", "rad/s", variance=0.01**2),), h=gyro),
    ),
    f=turn,
    linear=True,
)


def simulate(seed=0, duration=120.0, bias=0.03):
    """Return a log of a boat that circles: gyro at 10 Hz, compass at 1 Hz, true states."""
    rng = np.random.default_rng(seed)
    t = np.arange(1, int(10 * duration) + 1) / 10
    rate = 0.2 + np.cumsum(rng.normal(0.0, math.sqrt(1e-3 / 10), t.size))
    heading = 2.5 + np.cumsum(rate) / 10
    log = Log.of(BOAT, start=0.0)
    log.add("gyro", t, rate + bias + rng.normal(0.0, 0.01, t.size))
    wrapped = np.angle(np.exp(1j * (heading + rng.normal(0.0, 0.1, t.size))))  # a compass reads -π to π
    log.add("compass", t[9::10], wrapped[9::10])
    log.add_truth(t, heading=np.angle(np.exp(1j * heading)), rate=rate, bias=np.full(t.size, bias))
    return log


if __name__ == "__main__":
    run = fold("ekf", BOAT, simulate(), covariance=True)
    for name, fit in run.score().states.items():
        print(f"{name:<8} RMSE {fit.rmse:.4f}")
    print(f"bias at the end {run.mean[-1, 2]:.4f} ± {2 * run.std[-1, 2]:.4f} rad/s, true 0.03")
    print(f"NEES per state {run.nees().mean:.2f}")
