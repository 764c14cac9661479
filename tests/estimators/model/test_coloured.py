"""Noise that lasts: what filters make of it, beside a joint Gaussian written down in closed form."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from estimators.fold import fold
from estimators.log import READING, Events, Log
from estimators.model.coloured import Lasting, coloured
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.tuning import Tuning

TAU, Q, R, STD, ERROR = 7.0, 0.3, 0.04, 2.0, 0.6

STEPS = np.array([0.0, 1e-3, 0.5, 2.0, 0.01, 9.0, 300.0, 0.25, 7.0, 40.0, 1e-2, 1.0, 1000.0])
"""Seconds between readings, from a small part of the correlation time to many of them; the prior holds at the first."""


def stay(x, u, p, dt, out):
    out[0] = x[0]


def told(x, u, p, out):
    out[0] = x[0]


WALK = StateSpaceModel(
    name="walk",
    title="A level that wanders",
    states=(State("level", "m", mean=1.0, std=STD),),
    noises=(Noise("level", "m²/s", Q),),
    sensors=(Sensor("gauge", (Row("gauge", "m", R),), h=told),),
    f=stay,
    linear=True,
)


def wandered(times, tau=TAU):
    """Covariance of ∫c dt from 0 to each of the times, c an OU process in its steady state: the double integral of
    q/(2τ) exp(-|s - t|/τ)."""
    s, t = times[:, None], times[None, :]
    edge = 1.0 - np.exp(-s / tau) - np.exp(-t / tau) + np.exp(-np.abs(s - t) / tau)
    return Q * (np.minimum(s, t) - 0.5 * tau * edge)


def lasted(times, tau=TAU):
    """Covariance of the error of a sensor."""
    return ERROR**2 * np.exp(-np.abs(times[:, None] - times[None, :]) / tau)


def log_of(times, y):
    log = Log(1)
    for t, value in zip(times, y, strict=True):
        log.extend(Events.one(round(t * 1e9), 0, READING, 0, value, 1))
    return log


def regression(level, readings):
    """Mean and std of the level after each reading, and the density of each reading given those before.

    `level` and `readings` are covariances of the level at the readings, and of the readings (T, T); both have mean 1.
    """
    y = np.random.default_rng(3).multivariate_normal(np.ones(len(readings)), readings)
    means, stds, densities, before = [], [], [], 0.0
    for k in range(1, len(y) + 1):
        weights = np.linalg.solve(readings[:k, :k], level[:k, k - 1])
        means.append(1.0 + weights @ (y[:k] - 1.0))
        stds.append(np.sqrt(level[k - 1, k - 1] - weights @ level[:k, k - 1]))
        joint = multivariate_normal(np.ones(k), readings[:k, :k]).logpdf(y[:k])
        densities.append(joint - before)
        before = joint
    return y, np.array(means), np.array(stds), np.array(densities)


def agree(estimator, model, level, readings, times, tolerance=1e-9):
    y, mean, std, density = regression(level, readings)
    track = fold(estimator, model, Tuning.of(model), log_of(times, y))
    np.testing.assert_allclose(track.mean[:, 0], mean, rtol=0, atol=tolerance)
    np.testing.assert_allclose(track.std[:, 0], std, rtol=0, atol=tolerance)
    np.testing.assert_allclose(track.log_likelihood, density, rtol=0, atol=10 * tolerance)


@pytest.mark.parametrize("estimator", ["kf"])
def test_a_level_driven_by_noise_that_lasts_is_the_regression_on_its_covariance(estimator):
    times = np.cumsum(STEPS)
    level = STD**2 + wandered(times)
    agree(estimator, coloured(WALK, {"level": TAU}), level, level + R * np.eye(len(times)), times)


@pytest.mark.parametrize("estimator", ["kf"])
def test_an_error_of_a_sensor_that_lasts_is_the_regression_on_its_covariance(estimator):
    times = np.cumsum(STEPS)
    level = STD**2 + Q * np.minimum(times[:, None], times[None, :])
    readings = level + lasted(times) + R * np.eye(len(times))
    agree(estimator, coloured(WALK, errors={"gauge": Lasting((ERROR,), TAU)}), level, readings, times)
