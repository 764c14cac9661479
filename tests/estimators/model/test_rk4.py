"""Runge-Kutta steps of rate functions, against the exact solution of a linear system."""

import numpy as np
import pytest
from scipy.linalg import expm

from estimators import rk4
from estimators.compiled.model import compile_model
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from tests.models import first_state

A = np.array([[0.0, 1.0], [-4.0, -0.4]])
"""A damped oscillator: x'' = -p0 x - p1 x' + u."""

U, P = np.array([1.5]), np.array([4.0, 0.4])


def returned(x, u, p):
    return x[1], u[0] - p[0] * x[0] - p[1] * x[1]


def filled(x, u, p, out):
    out[0] = x[1]
    out[1] = u[0] - p[0] * x[0] - p[1] * x[1]


def terms(u, p):
    return u[0], p[0], p[1]


def of_terms(x, force, stiffness, damping):
    return x[1], force - stiffness * x[0] - damping * x[1]


STEPS = {"returned": rk4(returned), "filled": rk4(filled), "constants": rk4(of_terms, terms)}


def model(f):
    return StateSpaceModel(
        name="oscillator",
        title="oscillator",
        states=(State("x", "m", std=1.0), State("v", "m/s", std=1.0)),
        inputs=(Input("force", "m/s²"),),
        parameters=(Parameter("stiffness", "1/s²", 4.0), Parameter("damping", "1/s", 0.4)),
        noises=(Noise("v", "m²/s³", 0.1),),
        sensors=(Sensor("x", (Row("x", "m", 0.1),), h=first_state),),
        f=f,
    )


def after(f, seconds, steps):
    x, out = np.array([1.0, 0.5]), np.empty(2)
    for _ in range(steps):
        f(x, U, P, seconds / steps, out)
        x = out.copy()
    return x


@pytest.mark.parametrize("f", STEPS.values(), ids=STEPS)
def test_a_step_is_the_taylor_polynomial_of_degree_four(f):
    """For x' = A x + b the step is Σ (A dt)^k / k! up to k = 4, about the rest position, exactly but for rounding."""
    rest, dt = np.linalg.solve(A, [0.0, -U[0]]), 0.1
    factor = sum(np.linalg.matrix_power(A * dt, k) / float(np.prod(range(1, k + 1))) for k in range(5))
    exact = rest + factor @ (np.array([1.0, 0.5]) - rest)
    np.testing.assert_allclose(after(f, dt, 1), exact, rtol=1e-14)


@pytest.mark.parametrize("f", STEPS.values(), ids=STEPS)
def test_the_error_over_a_fixed_time_falls_with_the_fourth_power_of_the_step(f):
    """Each step is off by (A dt)^5 / 120, so half the step leaves 1/16; the next order, dt/6 |A|, is below 2 %."""
    rest = np.linalg.solve(A, [0.0, -U[0]])
    exact = rest + expm(A * 2.0) @ (np.array([1.0, 0.5]) - rest)
    errors = [np.linalg.norm(after(f, 2.0, steps) - exact) for steps in (50, 100, 200)]
    assert errors[0] < 2.0 * np.linalg.norm(A, 2) ** 5 * 0.04**4 / 120
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.1)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(4.0, abs=0.1)


def scaled(factor):
    def rates(x, u, p):
        return x[1], factor * x[0]

    return rates


def test_compiled_steps_equal_python_and_are_kept_apart_by_the_values_that_they_enclose():
    for f in (*STEPS.values(), rk4(scaled(1.0)), rk4(scaled(2.0))):
        x, out = np.array([1.0, 0.5]), np.empty(2)
        compile_model(model(f)).f(x, U, P, 0.1, out)
        np.testing.assert_allclose(out, after(f, 0.1, 1), rtol=1e-15)
