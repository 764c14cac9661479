"""The linearised filter beside the unscented one: alike on a linear model, apart by the curvature on another."""

import numpy as np
import pytest

from estimators.diagnostics.sensitivity.checklist import linearity
from estimators.fold import fold
from estimators.model.state_space import StateSpaceModel
from estimators.tuning import Tuning
from tests.estimators.diagnostics.sensitivity.models import log_of
from tests.models import first_state, level_model, many_states
from tests.models import first_state_squared as square


def model(h, std: float) -> StateSpaceModel:
    return level_model({"y": 1.0}, 0.01, state="x", mean=3.0, std=std, h=h)


def test_a_straight_line_passes_without_difference():
    one = model(first_state, 2.0)
    rng = np.random.default_rng(1)
    x = 3.0 + np.cumsum(0.1 * rng.normal(size=500))
    found = linearity(one, Tuning.of(one), log_of(one, x + rng.normal(size=500)))
    assert found.reason == "" and found.passes and found.white
    assert max(item.most for item in (*found.states, *found.rows)) < 1e-6
    assert found.whiteness[0].p_linearised == pytest.approx(found.whiteness[0].p_unscented, rel=1e-5)


def test_a_curve_is_told_by_what_it_does_to_the_prediction():
    # E x² is m² + P, which the unscented transform has and a tangent at the mean does not.
    std, q = 2.0, 0.01
    one = model(square, std)
    log = log_of(one, [9.0])
    found = linearity(one, Tuning.of(one), log)
    spread = fold("ukf", one, Tuning.of(one), log).innovation_std[0, 0]
    p = std**2  # the first event is at the time of the prior
    assert found.rows[0].most == pytest.approx(p / spread, rel=1e-9)
    assert found.passes is False
    assert "does not pass" in found.text
    # Over a spread of a hundredth the curve is a line.
    narrow = model(square, 0.01)
    tuning = Tuning.of(narrow).set("Q.x", 1e-8 * q)
    assert linearity(narrow, tuning, log_of(narrow, [9.0])).passes


def test_what_no_gaussian_filter_carries_is_said():
    large = many_states(65)
    found = linearity(large, Tuning.of(large), log_of(large, [0.0]))
    assert found.passes is None
    assert found.reason == "many has 65 states; a linearised model is tried up to 64"
