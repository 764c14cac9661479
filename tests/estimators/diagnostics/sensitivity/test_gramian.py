"""Observability against the information matrix of all readings at once."""

import numpy as np
import pytest

from estimators.diagnostics.sensitivity import gramian
from estimators.log import Log
from estimators.model import Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.tuning import Tuning
from tests.models import first_state

from .models import COUPLED, simulate

N = 40
STEP = 1e-7
"""Central differences of a linear model are exact but for rounding, 1e-16 of values near 10 over a step of 1e-3."""


def dense(n, transition, noise, row, variance, std, first=0):
    """Oᵀ N⁻¹ O of n readings a step apart, in units of `std`: N has the process noise that two readings share.

    The state is that of `first` steps before the first reading.
    """
    states = len(std)
    powers = [np.linalg.matrix_power(transition, k) for k in range(n + first)]
    observed = np.stack([row @ power for power in powers[first:]])
    cov = np.eye(n) * variance
    for k in range(n):
        for j in range(n):
            for i in range(1, min(k, j) + first + 1):
                cov[k, j] += row @ powers[k + first - i] @ noise @ powers[j + first - i].T @ row
    assert observed.shape == (n, states)
    scaled = observed * std
    return scaled.T @ np.linalg.solve(cov, scaled)


def coupled_matrix():
    a, b, c = (item.value for item in COUPLED.parameters)
    return np.array([[1 - a, a], [b, 1 - b - c]])


def test_the_gramian_of_a_linear_model():
    log, _ = simulate(np.random.default_rng(1), N)
    found = gramian("ekf", COUPLED, Tuning.of(COUPLED), log)
    J = dense(N, coupled_matrix(), 0.01 * np.eye(2), np.array([1.0, 0.0]), 0.04, COUPLED.prior_std)
    np.testing.assert_allclose(found.whole.gramian, J, rtol=1e-5, atol=1e-6)
    values, vectors = np.linalg.eigh(J)
    np.testing.assert_allclose(found.whole.eigenvalues, values, rtol=1e-5)
    assert found.whole.rank == 2 and found.whole.conditioning == pytest.approx(values[1] / values[0], rel=1e-5)
    left = np.linalg.inv(np.eye(2) + J)
    np.testing.assert_allclose(found.whole.deviation, np.sqrt(np.diag(left)), rtol=1e-6)
    assert abs(found.whole.weakest @ vectors[:, 0]) == pytest.approx(1.0)
    assert found.whole.text.startswith("core")


def test_windows_are_logs_of_their_own():
    log, _ = simulate(np.random.default_rng(2), 4 * N)
    found = gramian("ekf", COUPLED, Tuning.of(COUPLED), log, windows=4)
    assert len(found.windows) == 4
    # The first begins with its first reading; the others a second before it, as their base is the event before.
    first = dense(N, coupled_matrix(), 0.01 * np.eye(2), np.array([1.0, 0.0]), 0.04, COUPLED.prior_std)
    np.testing.assert_allclose(found.windows[0].gramian, first, rtol=1e-5, atol=1e-6)
    for before, after in zip(found.windows, found.windows[1:]):
        assert before.end < after.begin
    # A linear model is as observable at one time as at another.
    later = dense(N, coupled_matrix(), 0.01 * np.eye(2), np.array([1.0, 0.0]), 0.04, COUPLED.prior_std, first=1)
    np.testing.assert_allclose(found.windows[1].gramian, later, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found.windows[1].gramian, found.windows[2].gramian, rtol=1e-5, atol=1e-6)


def test_a_state_that_nothing_sees():
    model = MODELS["motor_winding"]
    log = Log.of(model)
    log.add("winding", 0.0, 35.0)
    found = gramian("kf", model, Tuning.of(model), log)
    # One reading of the temperature tells 5² / 4 of it, and nothing of its rate.
    np.testing.assert_allclose(found.whole.eigenvalues, [0.0, 25.0 / 4.0], atol=1e-8)
    assert found.whole.rank == 1 and np.isinf(found.whole.conditioning)
    assert found.whole.text == "rate +1 °C/s: 100 % of its prior deviation is left"


def test_a_field_is_refused():
    model = MODELS["thermal_field"]
    found = gramian("enkf", model, Tuning.of(model), Log.of(model))
    assert found.whole is None and "64" in found.reason


@pytest.mark.parametrize(("rate", "observed"), [(0.0, False), (0.001, False), (0.5, True)])
def test_a_state_that_forgets_its_prior_needs_no_measurement(rate, observed):
    """A second state that nothing measures and that decays: e^-rate·n of its prior is left after n seconds."""

    def f(x, u, p, dt, out):
        out[0], out[1] = x[0], x[1] * np.exp(-p[0] * dt)

    model = StateSpaceModel(
        name=f"decay{rate}",
        title="",
        states=(State("level", "m", 0.0, 2.0), State("error", "m", 0.0, 3.0)),
        parameters=(Parameter("rate", "1/s", rate, 0.0, 1.0),),
        noises=(Noise("level", "m²/s", 0.1), Noise("error", "m²/s", 0.1)),
        sensors=(Sensor("gauge", (Row("gauge", "m", 1.0),), h=first_state),),
        f=f,
    )
    log = Log.of(model)
    log.add("gauge", np.arange(N + 1.0), np.random.default_rng(3).standard_normal(N + 1))
    found = gramian("ekf", model, Tuning.of(model), log, windows=0).whole
    assert found.rank == 1 and found.deviation[1] == pytest.approx(1.0, abs=1e-9)
    assert found.kept[1] == pytest.approx(np.exp(-rate * N), rel=1e-6)
    assert found.unobserved(model) == ([] if observed else ["error"]) and found.forgotten == observed
    assert found.text.startswith("level" if observed else "error")
    assert found.summary.startswith("rank 1 of 2 (1 forgotten), conditioning 1" if observed else "rank 1 of 2, ")
