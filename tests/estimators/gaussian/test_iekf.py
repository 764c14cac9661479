"""The iterated EKF: the EKF when it iterates once, the mode of the posterior when it iterates on."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from estimators.fold import Fold, fold
from estimators.log import READING, Events, Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.track import FAILED
from estimators.tuning import Tuning
from tests.estimators.gaussian.test_square_root import EVERYTHING
from tests.estimators.interpreted.test_filterpy import P0, PENDULUM, X0, H_of, R, hx, log  # noqa: F401  the fixture
from tests.estimators.linear_models import random_linear, random_log


@pytest.mark.parametrize("joseph", [0, 1])
@pytest.mark.parametrize("options", EVERYTHING, ids=str)
def test_one_iteration_is_the_ekf_to_the_bit(log, options, joseph):  # noqa: F811
    options = {**options, "joseph": joseph}
    once = fold("iekf", PENDULUM, Tuning.of(PENDULUM).with_options({**options, "iterations": 1}), log)
    ekf = fold("ekf", PENDULUM, Tuning.of(PENDULUM).with_options(options), log)
    for name, left, right in zip(ekf._fields, once, ekf, strict=True):
        np.testing.assert_array_equal(left, right, err_msg=name)


@pytest.mark.parametrize("iterations", [2, 3, 20])
def test_on_a_linear_model_the_count_does_not_matter(iterations):
    matrices = random_linear(np.random.default_rng(5), 4, 1)
    events = random_log(np.random.default_rng(6), matrices, 60)
    tuning = Tuning.of(matrices.model)
    once = fold("iekf", matrices.model, tuning.with_options({"iterations": 1}), events)
    often = fold("iekf", matrices.model, tuning.with_options({"iterations": iterations}), events)
    # Each count adds the rounding of y - h(x) - H (x̂ - x), which is a few 1e-16 of numbers of order 10.
    for name in ("mean", "std", "nis", "log_likelihood"):
        np.testing.assert_allclose(getattr(often, name), getattr(once, name), rtol=1e-11, atol=1e-11, err_msg=name)


@pytest.mark.parametrize(("sensor", "y"), [(0, [1.0]), (1, [-1.0, 2.9]), (1, [np.nan, 3.0])])
def test_many_iterations_find_the_mode_and_count_the_reading_once(sensor, y):
    """The minimum of ½ |x - x̂|²_P⁻¹ + ½ |y - h(x)|²_R⁻¹ by scipy, and P = (P⁻¹ + Hᵀ R⁻¹ H)⁻¹ there."""
    readings = Log(2)
    readings.extend(Events.one(0, 0, READING, sensor, y, 2))
    folded = Fold("iekf", PENDULUM, Tuning.of(PENDULUM).with_options({"iterations": 20}), readings)
    folded.advance()
    finite = np.isfinite(y)
    y, r = np.array(y)[finite], R[sensor][finite]

    def residuals(x):
        return np.concatenate(((x - X0) / np.sqrt(P0), (y - hx(sensor, x)[finite]) / np.sqrt(r)))

    best = least_squares(residuals, X0, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    H = H_of(sensor, best)[finite]
    mean, cov = folded.moments()
    assert np.max(np.abs(best - fold("ekf", PENDULUM, Tuning.of(PENDULUM), readings).mean[0])) > 1e-2
    # scipy stops when its gradient is 1e-15 of its size at the start: the mode is good to about 1e-8.
    np.testing.assert_allclose(mean, best, rtol=0, atol=1e-7)
    np.testing.assert_allclose(cov, np.linalg.inv(np.diag(1 / P0) + H.T @ np.diag(1 / r) @ H), rtol=0, atol=1e-7)


def still(x, u, p, dt, out):
    out[0] = x[0]


def cliff(x, u, p, out):
    out[0] = np.log(x[0])


def test_an_iteration_that_leaves_the_model_fails_visibly():
    """y = log x from 1 ± 10, reading -3: the first step leads to -1.9, where there is no logarithm."""
    model = StateSpaceModel(
        name="cliff",
        title="cliff",
        states=(State("x", "1", mean=1.0, std=10.0),),
        noises=(Noise("x", "1", variance=1.0),),
        sensors=(Sensor("y", (Row("y", "1", variance=1.0),), h=cliff),),
        f=still,
    )
    readings = Log(1)
    readings.extend(Events.one(0, 0, READING, 0, -3.0, 1))
    track = fold("iekf", model, Tuning.of(model), readings)
    assert track.verdict[0] == FAILED
    assert (track.mean[0, 0], track.std[0, 0]) == (1.0, 10.0)
