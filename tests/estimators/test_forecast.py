"""Forecasts against closed forms and against paths drawn by NumPy; and that a fold is left as it was."""

import numpy as np
import pytest
from scipy.stats import norm

from estimators.errors import EstimatorError
from estimators.forecast import SIGMAS, first_time, forecast
from estimators.log import INPUT, READING, Events
from tests.estimators.linear_models import random_linear, random_log
from tests.models import level_model
from tests.support import SECOND, as_log, assert_same, folded, log_of

SURE = 4.5
"""Standard errors that a test by chance may be off: once in 150,000 looks."""


WALK = level_model({"y": 0.04}, 0.3, state="s", mean=1.0, std=0.5, linear=True)


def ahead(made, horizon, step, **more):
    base, now = made.base_here(), int(made.log.t[made.n - 1])
    return forecast(made.estimator.name, made.model, made.tuning, base, now, horizon, step, **more)


@pytest.mark.parametrize("estimator", ["kf", "ekf", "ukf", "sr-kf"])
def test_a_linear_model_is_forecast_by_its_matrices(estimator):
    rng = np.random.default_rng(7)
    matrices = random_linear(rng, 3, 2)
    made = folded(estimator, matrices.model, random_log(rng, matrices, 40))
    x, P = made.moments()
    before = made.u
    now = int(made.log.t[made.n - 1])
    # The second input changes 1.2 s from now, in the midst of a step of 0.5 s.
    change = Events.one(now + int(1.2 * SECOND), 0, INPUT, 0, [np.nan, 3.0], matrices.model.width)
    found = ahead(made, 4.0, 0.5, inputs=change, most=4, limits={"x1": 2.0})
    ends = sorted({*np.arange(0.5, 4.01, 0.5), 1.2})
    u, t, means, covs = before.copy(), 0.0, [x], [P]
    for end in ends:
        dt = end - t
        F = np.eye(3) + dt * matrices.A
        x, P, t = F @ x + dt * matrices.B @ u, F @ P @ F.T + matrices.q * dt * matrices.W, end
        if end == 1.2:
            u[1] = 3.0
        if end in (1.0, 2.0, 3.0, 4.0):
            means.append(x)
            covs.append(P)
    std = np.sqrt([np.diag(P) for P in covs])
    # Rounding of some ten steps, and times that are whole nanoseconds.
    np.testing.assert_allclose(found.t, [0, 1, 2, 3, 4], atol=1e-9)
    np.testing.assert_allclose(found.mean, means, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(found.std, std, rtol=1e-7)
    for k, sigma in enumerate(SIGMAS):
        np.testing.assert_allclose(found.bands[:, k], np.array(means) + sigma * std, rtol=1e-7, atol=1e-7)
    above = means[0][1] < 2.0
    tail = norm.sf if above else norm.cdf
    assert found.members == 0 and found.crossings[0].above == above
    np.testing.assert_allclose(
        found.crossings[0].probability, tail(2.0, np.array(means)[:, 1], std[:, 1]), rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("estimator, count", [("pf", {"particles": 2000}), ("enkf", {"members": 2000})])
def test_members_have_the_quantiles_and_first_passages_of_paths(estimator, count):
    log = log_of(WALK.width, (0.0, READING, 1.2), (1.0, READING, 1.4))
    made = folded(estimator, WALK, log, options=count)
    exact = folded("kf", WALK, log)
    (mean,), ((start,),) = exact.moments()
    n, limit, horizon, step = 2000, 3.0, 10.0, 0.25
    found = ahead(made, horizon, step, limits={"s": limit}, most=10)  # four steps from one time to the next
    assert found.members == n and found.t.size == 11
    std = np.sqrt(start + 0.3 * found.t)
    # The filter's own cloud stands for N(mean, start) with as many members, after two updates by chance.
    error = SURE * np.sqrt(3.0) * std / np.sqrt(n)
    assert np.all(np.abs(found.mean[:, 0] - mean) < error)
    for k, sigma in enumerate(SIGMAS):
        # Of a sample's quantile: √(p (1 - p) / n) over the density there.
        p = norm.cdf(sigma)
        slack = SURE * np.sqrt(3.0) * std * np.sqrt(p * (1 - p) / n) / norm.pdf(sigma)
        assert np.all(np.abs(found.bands[:, k, 0] - (mean + sigma * std)) < slack)
    # The same walk by NumPy, looked at after each of the 40 steps: the share of paths that have passed.
    rng = np.random.default_rng(1)
    paths = mean + np.sqrt(start) * rng.normal(size=(200_000, 1))
    paths = np.hstack((paths, paths + np.cumsum(rng.normal(0, np.sqrt(0.3 * step), (200_000, 40)), axis=1)))
    passed = np.mean(np.maximum.accumulate(paths, axis=1) >= limit, axis=0)[::4]
    (crossing,) = found.crossings
    assert np.all(np.diff(crossing.probability) >= 0.0)
    assert np.all(np.abs(crossing.probability - passed) < SURE * np.sqrt(3.0 * passed * (1 - passed) / n) + 1e-3)
    # To have been beyond is likelier than to be beyond.
    assert crossing.probability[-1] > norm.sf(limit, mean, std[-1]) + 0.05


def test_a_limit_is_looked_at_from_the_side_of_the_mean():
    made = folded("kf", WALK, log_of(WALK.width, (0.0, READING, 1.2)))
    above, below = (ahead(made, 5.0, 1.0, limits={"s": limit}).crossings[0] for limit in (3.0, -1.0))
    assert above.above and not below.above
    mean, std = made.moments()[0][0], np.sqrt(made.moments()[1][0, 0] + 0.3 * 5.0)
    assert below.probability[-1] == pytest.approx(norm.cdf(-1.0, mean, std), rel=1e-6)


def test_the_fold_that_runs_is_not_disturbed():
    rng = np.random.default_rng(3)
    matrices = random_linear(rng, 2, 1)
    log = random_log(rng, matrices, 60)
    half = as_log(log.events.select(slice(0, 30)))
    made = folded("pf", matrices.model, half, options={"particles": 200})
    ahead(made, 3.0, 0.1, limits={"x0": 100.0})
    half.extend(log.events.select(slice(30, None)))
    made.advance()
    assert_same(made.track, folded("pf", matrices.model, log, options={"particles": 200}).track)


def test_a_silent_start_is_predicted_up_to_now():
    made = folded("kf", WALK, log_of(WALK.width, (0.0, READING, 1.2)))
    found = forecast("kf", WALK, made.tuning, made.base_here(), 20 * SECOND, 1.0, 1.0)
    np.testing.assert_allclose(found.std[:, 0] ** 2, made.moments()[1][0, 0] + 0.3 * np.array([20.0, 21.0]), rtol=1e-9)


def test_what_cannot_be_forecast_is_refused():
    made = folded("kf", WALK, log_of(WALK.width, (5.0, READING, 1.2)))
    with pytest.raises(EstimatorError, match="both must be positive"):
        ahead(made, 0.0, 1.0)
    with pytest.raises(EstimatorError, match="no state 'z'; it has s"):
        ahead(made, 1.0, 1.0, limits={"z": 1.0})
    with pytest.raises(EstimatorError, match="before the time of the state"):
        forecast("kf", WALK, made.tuning, made.base_here(), 0, 1.0, 1.0)


def test_what_happens_between_may_end_it():
    def stop():
        raise TimeoutError

    made = folded("kf", WALK, log_of(WALK.width, (0.0, READING, 1.2)))
    with pytest.raises(TimeoutError):
        ahead(made, 1.0, 0.1, between=stop)


def test_the_time_of_a_share_lies_between_two_times():
    t = np.array([0.0, 2.0, 4.0])
    p = np.array([0.0, 0.2, 0.8])
    assert first_time(t, p, 0.5) == pytest.approx(3.0)
    assert first_time(t, p, 0.0) == 0.0 and np.isnan(first_time(t, p, 0.9))
