"""The car of Särkkä's book, wrong by known factors of its noise, and its pendulum for the page of published figures.

Särkkä & Svensson, Bayesian Filtering and Smoothing, second edition (2023), examples 6.8 (the car), 7.6, 13.2 and on.

The companion code (github.com/EEA-sensors/Bayesian-Filtering-and-Smoothing) publishes its draws,
car_track.json and pendulum.json, and their errors in its notebooks. On those draws ours agreed with them to twelve
digits when this was written: readings 0.767985523725, kf 0.425382466053, smoothed 0.264971046382; ekf 0.168308590612,
0.057446202495; ukf (α 1, β 0, κ 1) 0.095243921259, 0.036617555415; ckf 0.114196603138, 0.040646242296; iekf
0.165475164721. Its iterated smoother (0.0346) goes over the whole log again and again; there is none of the kind here.
"""

import numpy as np
import pytest

from estimators import Log, fold
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.smoothing.smooth import consistency
from estimators.smoothing.walk import Smoothed
from tests.estimators.smoothing.test_second_opinions import PENDULUM
from tests.models import first_states
from tests.support import measured


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * x[2]
    out[1] = x[1] + dt * x[3]
    out[2] = x[2]
    out[3] = x[3]


def Q(x, u, p, q, dt, out):
    for i in range(2):
        out[i, i] = q[0] * dt**3 / 3.0
        out[i, i + 2] = out[i + 2, i] = q[0] * dt**2 / 2.0
        out[i + 2, i + 2] = q[0] * dt


MEAN = np.array([0.0, 0.0, 1.0, -1.0])
CAR = StateSpaceModel(
    name="car",
    title="a car whose place is read",
    states=tuple(
        State(name, unit, mean=mean, std=1.0)
        for name, unit, mean in zip(("east", "north", "v_east", "v_north"), ("m", "m", "m/s", "m/s"), MEAN, strict=True)
    ),
    noises=(Noise("push", "m²/s³", variance=1.0),),
    sensors=(Sensor("place", (Row("east", "m", variance=0.25), Row("north", "m", variance=0.25)), h=first_states),),
    f=f,
    Q=Q,
    linear=True,
)


def rms(error):
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def car(seed, n=100, dt=0.1):
    rng = np.random.default_rng(seed)
    block = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    noise = np.linalg.cholesky(np.kron(block, np.eye(2)))
    F = np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(2))
    x, xs = rng.normal(MEAN, 1.0), []
    for _ in range(n):
        x = F @ x + noise @ rng.normal(size=4)
        xs.append(x)
    xs = np.array(xs)
    ys = xs[:, :2] + 0.5 * rng.normal(size=(n, 2))
    log = measured(CAR, "place", dt * np.arange(1, n + 1), ys, start=0.0)
    return xs, ys, log


def pendulum(estimator, n=500, dt=0.01, **options):
    """Return the RMSE of the angle in 49 draws: the truth starts at 1.5 rad, the estimate at N(0, I)."""
    noise, found = np.linalg.cholesky(0.01 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])), []
    for seed in range(49):
        rng = np.random.default_rng(seed)
        xs, log = np.empty((n + 1, 2)), Log.of(PENDULUM, start=0.0)
        xs[0] = 1.5, 0.0
        for before, after in zip(xs[:-1], xs[1:], strict=True):
            PENDULUM.f(before, None, None, dt, after)
            after += noise @ rng.normal(size=2)
        log.add("height", dt * np.arange(1, n + 1), np.sin(xs[1:, 0]) + np.sqrt(0.1) * rng.normal(size=n))
        prior = np.zeros(2), np.eye(2)
        both = (fold(estimator, PENDULUM, log, prior=prior, smoothed=each, **options) for each in (False, True))
        found.append([rms(each.mean[:, :1] - xs[1:, :1]) for each in both])
    return dict(zip(("RMSE filtered", "RMSE smoothed"), np.transpose(found), strict=True))


@pytest.mark.parametrize(("factor", "low", "high"), [(1.0, 0.9, 1.1), (0.01, 2.0, np.inf), (100.0, 0.0, 0.85)])
def test_a_noise_that_is_right_too_small_or_too_large(factor, low, high):
    found = []
    for seed in range(40):
        _, _, log = car(seed)
        filtered, smoothed = (fold("kf", CAR, log, Q={"push": factor}, smoothed=each) for each in (False, True))
        each = Smoothed(smoothed.mean, smoothed.std, smoothed.track.cross)
        found.append(list(consistency(filtered.track, each, CAR).values()))
    # 40 runs of some 20 independent stretches: the mean of as many squares scatters by √(2/800) = 0.05.
    place = np.mean(found, axis=0)[:2]
    assert np.all((low < place) & (place < high)), place
