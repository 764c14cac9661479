"""Peaks of clouds whose shape is known, and tails of innovations drawn from known distributions.

The linearised filter beside the unscented one: alike on a linear model, apart by the curvature on another.
"""

import numpy as np
import pytest

from estimators.diagnostics.sensitivity.checklist import linearity
from estimators.diagnostics.sensitivity.posterior import FAR_SIGMA, peaks, tails
from estimators.fold import fold
from estimators.model.state_space import StateSpaceModel
from estimators.tuning import Tuning
from tests.estimators.diagnostics.sensitivity.models import log_of
from tests.models import first_state, level_model, many_states
from tests.models import first_state as level
from tests.models import first_state_squared as square


def model(h, variance: float = 1.0) -> StateSpaceModel:
    return level_model({"y": variance}, 0.001, state="x", std=3.0, h=h)


def test_a_square_leaves_both_roots_and_a_level_one():
    rng = np.random.default_rng(2)
    noise = rng.normal(size=40)
    both = peaks("pf", model(square), Tuning.of(model(square)), log_of(model(square), 16.0 + noise))
    # After the first reading, which narrows the prior, few particles may differ.
    assert both.reason == "" and both.looks in (39, 40)
    # Each root has half the cloud: none dies out over 40 readings, of which resampling takes a few.
    assert both.several > 0.9 and both.most == 2
    one = peaks("pf", model(level), Tuning.of(model(level)), log_of(model(level), 4.0 + noise))
    assert (one.several, one.most) == (0.0, 1)


def test_a_cloud_that_collapses_tells_nothing():
    sharp = model(level, 1e-10)
    found = peaks("pf", sharp, Tuning.of(sharp), log_of(sharp, np.full(30, 1.0)))
    assert found.collapsed > 0.5
    assert "particles of pf differ" in found.reason


def test_too_many_states_for_particles():
    many = many_states(13)
    found = peaks("pf", many, Tuning.of(many), log_of(many, [0.0]))
    assert found.reason.startswith("13 states are too many")


@pytest.mark.parametrize("heavy", [False, True])
def test_tails_of_a_normal_and_of_a_student(heavy):
    n = 4000
    rng = np.random.default_rng(4)
    # Student's t with five degrees of freedom has an excess kurtosis of 6; a state that hardly moves leaves the noise.
    noise = rng.standard_t(5, size=n) * np.sqrt(3.0 / 5.0) if heavy else rng.normal(size=n)
    one = model(level)
    tuning = Tuning.of(one).set("Q.x", 1e-9)
    log = log_of(one, noise)
    (tail,) = tails(one, log, fold("ekf", one, tuning, log), marginal=False)
    assert tail.n == n and tail.row == "y"
    assert tail.heavy is heavy
    if heavy:
        assert tail.far > 10 * 6.3e-5 and tail.p_value < 1e-9
    else:
        # Four standard errors, √(24 / n); one beyond 4 σ is expected in 16,000.
        assert abs(tail.kurtosis) < 4.0 * np.sqrt(24.0 / n)
        assert tail.far * n <= 3 and FAR_SIGMA == 4.0


def levelled(h, std: float) -> StateSpaceModel:
    return level_model({"y": 1.0}, 0.01, state="x", mean=3.0, std=std, h=h)


def test_a_straight_line_passes_without_difference():
    one = levelled(first_state, 2.0)
    rng = np.random.default_rng(1)
    x = 3.0 + np.cumsum(0.1 * rng.normal(size=500))
    found = linearity(one, Tuning.of(one), log_of(one, x + rng.normal(size=500)))
    assert found.reason == "" and found.passes and found.white
    assert max(item.most for item in (*found.states, *found.rows)) < 1e-6
    assert found.whiteness[0].p_linearised == pytest.approx(found.whiteness[0].p_unscented, rel=1e-5)


def test_a_curve_is_told_by_what_it_does_to_the_prediction():
    # E x² is m² + P, which the unscented transform has and a tangent at the mean does not.
    std, q = 2.0, 0.01
    one = levelled(square, std)
    log = log_of(one, [9.0])
    found = linearity(one, Tuning.of(one), log)
    spread = fold("ukf", one, Tuning.of(one), log).innovation_std[0, 0]
    p = std**2  # the first event is at the time of the prior
    assert found.rows[0].most == pytest.approx(p / spread, rel=1e-9)
    assert found.passes is False
    assert "does not pass" in found.text
    # Over a spread of a hundredth the curve is a line.
    narrow = levelled(square, 0.01)
    tuning = Tuning.of(narrow).set("Q.x", 1e-8 * q)
    assert linearity(narrow, tuning, log_of(narrow, [9.0])).passes


def test_what_no_gaussian_filter_carries_is_said():
    large = many_states(65)
    found = linearity(large, Tuning.of(large), log_of(large, [0.0]))
    assert found.passes is None
    assert found.reason == "many has 65 states; a linearised model is tried up to 64"
