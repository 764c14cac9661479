"""The rover among radio anchors: its equations by hand, its simulated self, and what it makes of a recording."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.compiled.model import compile_model
from estimators.fold import fold
from estimators.log import truth_of
from estimators.models.uwb_rover import UWB_ROVER, uwb_rover
from estimators.tuning import Tuning
from sources.simulator import Simulator, constant_input, sine_input
from tests.skips import recorded
from tests.support import as_log, read_all


def parameters(**changed: float) -> np.ndarray:
    return np.array([changed.get(item.name, item.value) for item in UWB_ROVER.parameters])


def test_wheels_and_rates_say_the_same_and_ranges_are_scaled_and_late() -> None:
    compiled = compile_model(UWB_ROVER)
    p = parameters(track=0.4, odometry_scale=1.1, bias_time=2.0, reflection=0.3, anchor_3_east=5.0, anchor_3_north=-2.0)
    x = np.array([1.0, 2.0, 0.5, 0.01, 1.07, 0.1, 0.2, 0.3, 0.4])
    by_rates, by_wheels = np.empty(9), np.empty(9)
    compiled.f(x, np.array([0.8, 0.5, 0.0, 0.0]), p, 0.1, by_rates)
    compiled.f(x, np.array([0.0, 0.0, 0.9, 0.7]), p, 0.1, by_wheels)
    np.testing.assert_allclose(by_rates, by_wheels, rtol=1e-14)
    assert by_rates[2] == pytest.approx(0.5 + 0.1 * (0.5 - 0.01))
    assert np.hypot(*(by_rates[:2] - x[:2])) == pytest.approx(0.1 * 1.1 * 0.8)
    np.testing.assert_allclose(by_rates[5:], 0.3 + np.exp(-0.05) * (x[5:] - 0.3), rtol=1e-14)
    out = np.empty(1)
    compiled.h[2](x, np.zeros(4), p, out)
    assert out[0] == pytest.approx(1.07 * np.hypot(4.0, 4.0) + 0.3)


def test_any_number_of_anchors() -> None:
    model = uwb_rover(6)
    assert model.nx == 11 and len(model.sensors) == 6 and model.parameters[-1].name == "anchor_6_north"
    assert compile_model(model).h[5] is not None


@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
def test_a_simulated_rover_is_tracked_within_what_the_filter_says(estimator: str) -> None:
    """The mean of position² / variance, 2 when the filter is right, over 120 s whose errors last for seconds: about
    30 independent pairs, so its own standard deviation is 2 / √30, and 4 of these are 1.5.
    """
    prior = {"east": 1.0, "north": 1.0, "heading": 0.2, "yaw_rate_bias": 0.001}
    model = replace(UWB_ROVER, states=tuple(replace(s, std=prior.get(s.name, s.std)) for s in UWB_ROVER.states))
    source = Simulator(
        model,
        seed=5,
        step=0.1,
        duration=120.0,
        initial={"east": 0.5, "north": -0.5, "range_scale": 1.04},
        inputs={"speed": constant_input(0.8), "yaw_rate": sine_input(0.0, 0.4, 20.0)},
    )
    log = as_log(read_all(source))
    track = fold(estimator, model, Tuning.of(model), log)
    rows, _ = truth_of(log.events, 0)
    squares = sum(((track.mean[rows, k] - truth_of(log.events, k)[1]) / track.std[rows, k])[200:] ** 2 for k in (0, 1))
    assert np.mean(squares) == pytest.approx(2.0, abs=1.5)
    assert track.mean[-1, 4] == pytest.approx(1.04, abs=4 * track.std[-1, 4])


@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
def test_the_mower_finds_the_scale_of_its_ranges(estimator: str) -> None:
    """A least-squares line through the ranges and the true distances of each beacon gives 1.068 to 1.071."""
    twin, log = recorded("uwb_rover_plaza")
    track = fold(estimator, twin.model, twin.tuning, log)
    assert track.mean[-1, 4] == pytest.approx(1.0695, abs=0.005)
