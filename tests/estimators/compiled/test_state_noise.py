"""Noise that depends on the state does so where the step began, in every filter that propagates a covariance."""

import numpy as np
import pytest

from estimators.fold import fold
from estimators.log import TICK, Events, Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.tuning import Tuning


def double(x, u, p, dt, out):
    out[0] = 2.0 * x[0]


def itself(x, u, p, out):
    out[0] = x[0]


def relative(x, u, p, q, dt, out):
    out[0, 0] = q[0] * dt * x[0] * x[0]


@pytest.mark.parametrize("estimator", ["ekf", "iekf", "ukf", "ckf", "sr-ekf", "sr-ukf", "filterpy-ekf", "filterpy-ukf"])
def test_noise_is_that_of_the_state_before_the_step(estimator):
    """x = 3 ± 0.5 doubles in 1 s with Q = 0.1 x²: P = 4·0.25 + 0.1·9, not 0.1·36."""
    model = StateSpaceModel(
        name="growing",
        title="growing",
        states=(State("x", "m", mean=3.0, std=0.5),),
        noises=(Noise("x", "1/s", 0.1),),
        sensors=(Sensor("y", (Row("y", "m", 1.0),), h=itself),),
        f=double,
        Q=relative,
    )
    log = Log(1)
    for t in (0, 1_000_000_000):
        log.extend(Events.one(t, 0, TICK, 0, [], 1))
    track = fold(estimator, model, Tuning.of(model), log)
    np.testing.assert_allclose(track.mean[1, 0], 6.0, rtol=1e-14)
    np.testing.assert_allclose(track.std[1, 0] ** 2, 1.9, rtol=1e-13)
