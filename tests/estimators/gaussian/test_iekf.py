"""The iterated EKF: the EKF when it iterates once, the mode of the posterior when it iterates on."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from estimators.log import READING
from estimators.track import FAILED
from tests.estimators.gaussian.test_square_root import EVERYTHING
from tests.estimators.interpreted.test_filterpy import P0, PENDULUM, X0, log  # noqa: F401  the fixture
from tests.models import complex_step, first_state_squared, level_model
from tests.support import assert_same, folded, log_of


@pytest.mark.parametrize("joseph", [0, 1])
@pytest.mark.parametrize("options", EVERYTHING, ids=str)
def test_one_iteration_is_the_ekf_to_the_bit(log, options, joseph):  # noqa: F811
    options = {**options, "joseph": joseph}
    once = folded("iekf", PENDULUM, log, options={**options, "iterations": 1}).track
    ekf = folded("ekf", PENDULUM, log, options=options).track
    assert_same(once, ekf)


@pytest.mark.parametrize(("sensor", "y"), [(0, [1.0]), (1, [-1.0, 2.9]), (1, [np.nan, 3.0])])
def test_many_iterations_find_the_mode_and_count_the_reading_once(sensor, y):
    """The minimum of ½ |x - x̂|²_P⁻¹ + ½ |y - h(x)|²_R⁻¹ by scipy, and P = (P⁻¹ + Hᵀ R⁻¹ H)⁻¹ there."""
    readings = log_of(2, (0, READING, y, sensor))
    finite, rows, h = np.isfinite(y), PENDULUM.sensors[sensor].rows, PENDULUM.sensors[sensor].h
    y, r = np.array(y)[finite], np.array([row.variance for row in rows])[finite]

    def residuals(x):
        expected = np.empty(len(rows))
        h(x, [], [], expected)
        return np.concatenate(((x - X0) / np.sqrt(P0), (y - expected[finite]) / np.sqrt(r)))

    best = least_squares(residuals, X0, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    H = complex_step(lambda x, out: h(x, [], [], out), best, len(rows))[finite]
    mean, cov = folded("iekf", PENDULUM, readings, options={"iterations": 20}).moments()
    assert np.max(np.abs(best - folded("ekf", PENDULUM, readings).track.mean[0])) > 1e-2
    # scipy stops when its gradient is 1e-15 of its size at the start: the mode is good to about 1e-8.
    np.testing.assert_allclose(mean, best, rtol=0, atol=1e-7)
    np.testing.assert_allclose(cov, np.linalg.inv(np.diag(1 / P0) + H.T @ np.diag(1 / r) @ H), rtol=0, atol=1e-7)


@pytest.mark.parametrize("most", [3, 100])
def test_iterations_end_with_a_step_below_1e_10_deviations(most):
    """Gauss-Newton by hand, whose steps shrink by a third: it ends 1.3e-11 before the mode, after 24 of them."""
    x = 1.0
    for _ in range(most):
        before, H = x, 2.0 * x
        x = 1.0 - H * (before * before + H * (1.0 - before)) / (H * H + 0.04 / 0.25)
        if abs(x - before) < 1e-10 * 0.5:
            break
    model = level_model({"y": 0.04}, 0.0, mean=1.0, std=0.5, h=first_state_squared)
    track = folded("iekf", model, log_of(1, (0, READING, 0.0)), options={"iterations": most}).track
    assert track.mean[0, 0] == pytest.approx(x, rel=0, abs=1e-13)


def cliff(x, u, p, out):
    out[0] = np.log(x[0])


def test_an_iteration_that_leaves_the_model_fails_visibly():
    """y = log x from 1 ± 10, reading -3: the first step leads to -1.9, where there is no logarithm."""
    model = level_model({"y": 1.0}, 1.0, state="x", mean=1.0, std=10.0, h=cliff)
    track = folded("iekf", model, log_of(1, (0, READING, -3.0))).track
    assert track.verdict[0] == FAILED
    assert (track.mean[0, 0], track.std[0, 0]) == (1.0, 10.0)
