"""Small linear models whose sensitivities are known, and logs of them."""

import numpy as np

from estimators.log import Log
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from tests.models import first_state, level_model

Q, R = 0.04, 0.25
"""Of the walk: variance that a step of one second adds, and that of a reading."""

PREDICTED = Q / 2.0 * (1.0 + np.sqrt(1.0 + 4.0 * R / Q))
"""P before a reading in the steady state: the positive root of P² - Q P - Q R = 0."""
S = PREDICTED + R
KEPT = 1.0 - PREDICTED / S
"""1 - K: the share of an error of the prediction that a reading leaves."""


def log_of(one: StateSpaceModel, values) -> Log:
    """A reading of y each second."""
    log = Log.of(one)
    log.add("y", np.arange(1.0, len(values) + 1.0), values)
    return log


def drift(x, u, p, dt, out):
    out[0] = x[0] + dt * (u[0] + p[0] + 1.0 / p[1])


WALK = level_model(
    {"level": R},
    Q,
    state="x",
    std=float(np.sqrt(PREDICTED)),
    inputs=(Input("push", "m/s"),),
    parameters=(Parameter("slope", "m/s", 0.0, -5.0, 5.0), Parameter("delay", "s/m", 1.0, 0.05, 400.0)),
    f=drift,
)
"""A random walk that drifts, in the filter's steady state from the first measurement on."""


TWICE = level_model({"level": {"coarse": R, "fine": 0.5 * R}}, Q, state="x")
"""A random walk read by two rows of one sensor."""


def coupled(x, u, p, dt, out):
    out[0] = x[0] + dt * (p[0] * (x[1] - x[0]) + u[0])
    out[1] = x[1] + dt * (p[1] * (x[0] - x[1]) - p[2] * (x[1] - u[1]))


COUPLED = StateSpaceModel(
    name="coupled",
    title="A heated shell with a thermometer, and a core without one",
    states=(State("shell", "°C", mean=0.0, std=1.0), State("core", "°C", mean=0.0, std=2.0)),
    inputs=(Input("heat", "°C/s"), Input("ambient", "°C")),
    parameters=(
        Parameter("exchange", "1/s", 0.2, 0.0, 0.5),
        Parameter("uptake", "1/s", 0.1, 0.0, 0.5),
        Parameter("loss", "1/s", 0.05, 0.0, 0.5),
    ),
    noises=(Noise("shell", "°C²/s", 0.01), Noise("core", "°C²/s", 0.01)),
    sensors=(Sensor("shell", (Row("shell", "°C", 0.04),), h=first_state),),
    f=coupled,
)


def heats(n):
    """Heat and ambient of n seconds, (n, 2): on and off."""
    return np.stack([np.where(np.arange(n) // 25 % 2, 0.0, 1.0), np.full(n, 3.0)], axis=1)


def simulate(rng, n, p=None, sensor=0.0, given=(0.0, 0.0)):
    """Readings, a second apart, of a coupled asset with other parameters, a bias, or inputs told wrong.

    Returns:
        The log, and the true states (n, 2) at its readings.
    """
    p = np.array([item.value for item in COUPLED.parameters]) if p is None else p
    x = rng.normal(COUPLED.prior_mean, COUPLED.prior_std)
    u = heats(n)
    xs, out = [], np.empty(2)
    for k in range(n):
        xs.append(x)
        coupled(x, u[k], p, 1.0, out)
        x = out + rng.normal(size=2) * 0.1
    xs = np.array(xs)
    log = Log.of(COUPLED, capacity=2 * n)
    t = np.arange(n, dtype=float)
    log.add_inputs(t, heat=u[:, 0] + given[0], ambient=u[:, 1] + given[1])
    log.add("shell", t, xs[:, 0] + rng.normal(size=n) * 0.2 + sensor)
    return log, xs
