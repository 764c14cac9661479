"""Monte Carlo comparison of filters: a pendulum of which only the horizontal position is measured.

Run: python docs/examples/compare_filters.py
"""

import math

import numpy as np

from nisus import Log, Noise, Row, Sensor, State, StateSpaceModel, fold_many, mean_nees

GRAVITY, STEP = 9.81, 0.05  # 1/s² for a length of 1 m; s


def swing(x, u, p, dt, out):
    """Angle and angular rate, dt seconds later (semi-implicit Euler)."""
    out[1] = x[1] - dt * GRAVITY * math.sin(x[0])
    out[0] = x[0] + dt * out[1]


def position(x, u, p, out):
    """Horizontal position of the bob, m."""
    out[0] = math.sin(x[0])


PENDULUM = StateSpaceModel(
    name="pendulum",
    title="Pendulum seen from above",
    states=(State("angle", "rad", mean=0.8, std=0.3), State("rate", "rad/s", mean=0.0, std=0.5)),
    noises=(Noise("angle", "rad²/s", variance=1e-4), Noise("rate", "rad²/s³", variance=0.05)),
    sensors=(Sensor("camera", (Row("position", "m", variance=0.05**2),), h=position),),
    f=swing,
)


def simulate(seed, steps=200):
    """Return a log with noisy measurements and the true states of one run."""
    rng = np.random.default_rng(seed)
    noise = np.sqrt([noise.variance * STEP for noise in PENDULUM.noises])
    x, states = rng.normal(PENDULUM.prior_mean, PENDULUM.prior_std), np.empty((steps, 2))
    for k in range(steps):
        swing(x.copy(), None, None, STEP, x)
        x += rng.normal(0.0, noise)
        states[k] = x
    seconds = STEP * np.arange(1, steps + 1)
    log = Log.of(PENDULUM, start=0.0)  # the prior holds at 0 s
    log.add("camera", seconds, np.sin(states[:, 0]) + rng.normal(0.0, 0.05, steps))
    log.add_truth(seconds, angle=states[:, 0], rate=states[:, 1])
    return log


def compare(filters=("ekf", "ukf", "enkf"), seeds=100):
    """Return, for each filter, its runs and their mean NEES."""
    logs = [simulate(seed) for seed in range(seeds)]
    found = {}
    for name in filters:
        runs = fold_many(name, PENDULUM, logs, covariance=True)
        found[name] = runs, mean_nees(runs)
    return found


if __name__ == "__main__":
    print("filter   RMSE angle   RMSE rate   NEES per state   in 95 % bounds")
    for name, (runs, nees) in compare().items():
        rmse = [np.sqrt(np.mean([run.score().states[state].rmse ** 2 for run in runs])) for state in ("angle", "rate")]
        print(f"{name:<8} {rmse[0]:7.4f} rad {rmse[1]:7.4f} rad/s   {nees.mean:9.2f} {100 * nees.inside:14.0f} %")
