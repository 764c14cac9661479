"""The catalogue: every entry is complete, and refuses what it cannot do with the reason."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.errors import EstimatorError
from estimators.fold import Fold, fold
from estimators.log import READING, Log
from estimators.models import MODELS
from estimators.registry import ESTIMATORS, checked, find_estimator
from estimators.tuning import Tuning
from tests.estimators.interpreted.test_filterpy import PENDULUM
from tests.estimators.linear_models import random_linear, random_log
from tests.support import folded, log_of

WINDING = MODELS["motor_winding"]
ANYBODYS = replace(WINDING, conditionally_linear=WINDING.state_names)
"""A model that every estimator takes."""


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_entries_are_complete(name):
    entry = ESTIMATORS[name]
    assert entry.name == name
    for text in ("title", "family", "assumes", "model_runs", "fails_when", "source"):
        assert getattr(entry, text).strip(), text
    assert "doi:" in entry.source or "19" in entry.source or "20" in entry.source
    for option in entry.options:
        assert option.low <= option.default <= option.high
        assert option.meaning


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_options_are_checked(name):
    entry = ESTIMATORS[name]
    assert entry.complete({}) == {option.name: option.default for option in entry.options}
    with pytest.raises(EstimatorError, match=f"{name} has no option 'wings'"):
        entry.complete({"wings": 2.0})
    for option in entry.options:
        assert entry.complete({option.name: option.high})[option.name] == option.high
        for value in (option.low - 1e-6, option.high + 1e-6, np.nan, np.inf):
            with pytest.raises(EstimatorError, match=f"{option.name} is .* must lie between"):
                entry.complete({option.name: value})
        if option.choices:
            assert (option.low, option.high) == (0.0, len(option.choices) - 1.0)
            with pytest.raises(EstimatorError, match=f"{option.name} is 0.5; it must be one of 0 .{option.choices[0]}"):
                entry.complete({option.name: 0.5})
        elif option.whole:
            with pytest.raises(EstimatorError, match=rf"{option.name} is .*\.5; it must be a whole number, such as"):
                entry.complete({option.name: option.low + 0.5})
        else:
            middle = 0.5 * (option.low + option.high)
            assert entry.complete({option.name: middle})[option.name] == middle
    model = ANYBODYS
    with pytest.raises(EstimatorError, match="no option"):
        Fold(name, model, Tuning.of(model).with_options({"wings": 2.0}), Log(1))


def test_what_is_counted_is_whole_and_what_is_measured_is_not():
    whole = {option.name for entry in ESTIMATORS.values() for option in entry.options if option.whole}
    assert whole == {"members", "particles", "rotation", "iterations"}


def test_a_radius_is_refused_where_the_model_says_no_positions():
    letkf = ESTIMATORS["letkf"]
    model = MODELS["lorenz96"]
    assert checked(letkf, model, {"radius": 4.0})["radius"] == 4.0
    assert checked(letkf, WINDING, {"radius": 0.0})["radius"] == 0.0
    with pytest.raises(EstimatorError, match="letkf: radius is 4, but model motor_winding .* where its states are"):
        checked(letkf, WINDING, {"radius": 4.0})
    blind = replace(model.sensors[0], rows=tuple(replace(row, position=None) for row in model.sensors[0].rows))
    with pytest.raises(EstimatorError, match="does not say where its sensor rows are; give them positions"):
        checked(letkf, replace(model, sensors=(blind, *model.sensors[1:])), {"radius": 4.0})


@pytest.mark.parametrize("name", ("ukf", "sr-ukf", "filterpy-ukf"))
def test_kappa_is_judged_by_the_number_of_states(name):
    """Julier & Uhlmann's kappa = 3 - n is below zero for more than three states: n + kappa alone must be above it."""
    entry, model = ESTIMATORS[name], MODELS["lorenz96"]
    assert checked(entry, model, {"kappa": 3.0 - model.nx})["kappa"] == -37.0
    said = (
        rf"{name}: kappa is -40, and lorenz96 has 40 states; .* must be positive: give more than -40, as 3 - nx = -37"
    )
    with pytest.raises(EstimatorError, match=said):
        checked(entry, model, {"kappa": -40.0})
    with pytest.raises(EstimatorError, match="kappa is -2, and motor_winding has 2 states"):
        Fold(name, WINDING, Tuning.of(WINDING).with_options({"kappa": -2.0}), Log(WINDING.width))


@pytest.mark.parametrize("name", ("ukf", "sr-ukf"))
def test_a_negative_kappa_is_the_kalman_filter_on_a_linear_model(name):
    """The central weight is negative then: 1 - n / 3."""
    matrices = random_linear(np.random.default_rng(3), 5, 2)
    log = random_log(np.random.default_rng(4), matrices, 12)
    tuning = Tuning.of(matrices.model)
    expected = fold("kf", matrices.model, tuning, log)
    track = fold(name, matrices.model, tuning.with_options({"kappa": -2.0}), log)
    np.testing.assert_allclose(track.mean, expected.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(track.std, expected.std, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("ukf", {"kappa": -1.0}),  # 3 - n of four states: Julier, Uhlmann & Durrant-Whyte (2000)
        ("ekf", {"inflation": 180.0}),  # per second: 1.053 a step of 0.01 s
        ("pf-reg", {"bandwidth": 2.48}),  # DAPPER's scripts for Lorenz63
        ("iekf", {"iterations": 50}),
        ("letkf", {"inflation": 2.5}),
    ],
)
def test_settings_as_published_are_within_the_limits(name, options):
    assert options.items() <= ESTIMATORS[name].complete(options).items()


def test_kf_refuses_a_nonlinear_model_and_names_what_to_use():
    with pytest.raises(EstimatorError, match="kf does not apply: pendulum is not linear; use an extended or unscented"):
        find_estimator("kf", PENDULUM)
    assert find_estimator("ekf", PENDULUM) is ESTIMATORS["ekf"]


def test_an_unknown_name_is_told_the_near_ones():
    with pytest.raises(EstimatorError, match="'ukff' does not exist; did you mean ukf"):
        find_estimator("ukff", PENDULUM)


def test_ukf_points_have_the_moments_of_the_state():
    model = WINDING
    log = log_of(1, (0, READING, 36.0))
    fold = folded("ukf", model, log, options={"alpha": 0.7, "kappa": 1.0})
    points = fold.points()
    mean, cov = fold.moments()
    assert points.shape == (5, 2)
    total = 0.7**2 * 3.0
    w = np.full(5, 0.5 / total)
    w[0] = 1 - 2 / total
    np.testing.assert_allclose(w @ points, mean, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose((points - mean).T @ np.diag(w) @ (points - mean), cov, rtol=1e-12, atol=1e-13)


def test_a_large_field_is_for_ensembles_and_the_refusal_has_the_arithmetic():
    model = MODELS["thermal_field"]
    with pytest.raises(EstimatorError, match="ukf of 40,000 states needs a 12.8 GB covariance.*use an ensemble filter"):
        find_estimator("ukf", model)
    # 2000 · 40,000 numbers of particles are 0.64 GB, the covariance that sums them up 12.8 GB.
    with pytest.raises(
        EstimatorError, match="pf of 40,000 states needs a 13.4 GB state, 2,000 particles and their cov"
    ):
        find_estimator("pf", model)
    with pytest.raises(EstimatorError, match="pf-ekf of 40,000 states needs a 25,6.. GB state"):  # one covariance each
        find_estimator("pf-ekf", model)
    assert find_estimator("etkf", model) is ESTIMATORS["etkf"]
