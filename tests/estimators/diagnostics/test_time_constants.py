"""Time constants of linear models whose matrices are chosen, and of the twins' defaults."""

import numpy as np
import pytest
from scipy.linalg import expm

from estimators.diagnostics.time_constants import jacobian, time_constants
from estimators.errors import ModelError
from tests.models import level_model


@pytest.mark.parametrize("dt", [0.01, 0.5, 5.0])
def test_modes_of_a_matrix_that_is_made_of_them(dt):
    """A = V diag(-1/τ) V⁻¹ with a random walk: F = exp(A dt) has those time constants for every dt."""
    rng = np.random.default_rng(1)
    tau = np.array([40.0, 7.0, 1.5])
    V = rng.normal(size=(4, 4))
    A = V @ np.diag([*(-1.0 / tau), 0.0]) @ np.linalg.inv(V)
    np.testing.assert_allclose(time_constants(expm(A * dt), dt), tau, rtol=1e-6)


def test_a_pair_that_swings_decays_with_its_envelope():
    """x'' = -2 d x' - w² x: both modes fall as exp(-d t)."""
    A = np.array([[0.0, 1.0], [-9.0, -0.4]])
    np.testing.assert_allclose(time_constants(expm(A * 0.1), 0.1), [5.0, 5.0], rtol=1e-9)


def test_what_does_not_decay_has_none():
    assert time_constants(np.array([[1.0, 0.1], [0.0, 1.0]]), 0.1).size == 0
    assert time_constants(np.array([[1.2]]), 0.1).size == 0
    assert time_constants(np.array([[np.nan]]), 0.1).size == 0


def relaxing(x, u, p, dt, out):
    out[0] = x[0] * np.exp(-dt * x[0] / 8.0)


def failing(x, u, p, dt, out):
    raise ZeroDivisionError("no")


def model(f):
    return level_model({"a": 1.0}, 0.1, state="a", name="one", mean=2.0, f=f)


def test_the_jacobian_is_taken_at_the_point_given():
    """d/dx of x exp(-dt x / 8) is (1 - dt x / 8) exp(-dt x / 8); central differences are right to 1e-9 or so."""
    F = jacobian(model(relaxing), np.array([2.0]), np.zeros(0), np.zeros(0), 0.5)
    np.testing.assert_allclose(F, [[(1 - 0.125) * np.exp(-0.125)]], rtol=1e-8)


def test_a_model_that_fails_there_says_so():
    with pytest.raises(ModelError, match="one: f fails at the prior: ZeroDivisionError: no"):
        jacobian(model(failing), np.array([2.0]), np.zeros(0), np.zeros(0), 0.5)
