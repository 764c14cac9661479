"""Complex step against derivatives written out by hand; central differences where a model is not analytic."""

import numpy as np
import pytest

from estimators.compiled.jacobians import ANALYTIC, CENTRAL, COMPLEX_STEP, complex_step, scratch_size
from estimators.compiled.model import compile_model
from estimators.fold import fold
from estimators.log import READING
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.numerics.jit import jit
from estimators.track import FAILED
from estimators.tuning import Tuning
from tests.support import folded, log_of, measured


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * (x[1] * x[2] + p[0] * np.exp(-x[0] * x[0]))
    out[1] = x[1] * np.cos(x[0]) - dt * p[1] * np.sqrt(x[2]) + u[0]
    out[2] = 1.0 + 0.3 * np.sqrt(x[2]) / (1.0 + x[0] ** 2) + dt * np.tanh(x[1])


@jit
def F(x, u, p, dt, out):
    out[0, 0] = 1.0 - dt * p[0] * 2.0 * x[0] * np.exp(-x[0] * x[0])
    out[0, 1] = dt * x[2]
    out[0, 2] = dt * x[1]
    out[1, 0] = -x[1] * np.sin(x[0])
    out[1, 1] = np.cos(x[0])
    out[1, 2] = -dt * p[1] * 0.5 / np.sqrt(x[2])
    out[2, 0] = -0.3 * np.sqrt(x[2]) * 2.0 * x[0] / (1.0 + x[0] ** 2) ** 2
    out[2, 1] = dt / np.cosh(x[1]) ** 2
    out[2, 2] = 0.15 / np.sqrt(x[2]) / (1.0 + x[0] ** 2)


def h(x, u, p, out):
    out[0] = np.log(x[2]) * np.sin(x[0])
    out[1] = x[0] * x[1] * x[2] + u[0] * x[1]


@jit
def H(x, u, p, out):
    out[0, 0] = np.log(x[2]) * np.cos(x[0])
    out[0, 1] = 0.0
    out[0, 2] = np.sin(x[0]) / x[2]
    out[1, 0] = x[1] * x[2]
    out[1, 1] = x[0] * x[2] + u[0]
    out[1, 2] = x[0] * x[1]


def saturated(x, u, p, dt, out):
    out[0] = min(max(x[0], -1.0), 1.0) + dt * x[1]
    out[1] = abs(x[1])
    out[2] = np.arctan2(x[0], x[2])


def magnitude(x, u, p, out):
    out[0] = abs(x[0])
    out[1] = np.arctan2(x[1], x[2])


def silently_wrong(x, u, p, dt, out):
    """Compiles for complex numbers, but |x|² as x·conj(x) is not analytic, and the complex step says nonsense."""
    out[0] = (x[0] * np.conj(x[0])).real
    out[1] = x[1]
    out[2] = x[2]


def model(f=f, h=h, F=None, H=None, **changes):
    declared = dict(
        name="curved",
        title="a curved model",
        states=(State("a", "1", 0.4, 0.3), State("b", "1", -0.7, 0.3), State("c", "1", 1.6, 0.2)),
        inputs=(Input("u", "1", 0.3),),
        parameters=(Parameter("p", "1", 1.3), Parameter("q", "1", 0.8)),
        noises=(Noise("a", "1", 0.1),),
        sensors=(Sensor("s", (Row("one", "1", 0.1), Row("two", "1", 0.2)), h=h, H=H),),
        f=f,
        F=F,
    )
    return StateSpaceModel(**{**declared, **changes})


U, P = np.array([0.3]), np.array([1.3, 0.8])


@pytest.mark.parametrize("seed", range(10))
def test_complex_step_is_exact(seed):
    rng = np.random.default_rng(seed)
    static = compile_model(model()).static
    assert static["F_mode"] == COMPLEX_STEP
    assert static["H_mode"][0] == COMPLEX_STEP
    x = np.array([rng.normal(), rng.normal(), rng.uniform(0.5, 3)])
    scratch = np.empty(scratch_size(3, 2))
    J, expected = np.empty((3, 3)), np.empty((3, 3))
    complex_step(static["f_complex"], False, x, U, P, 0.37, J, scratch)
    F(x, U, P, 0.37, expected)
    # No difference is taken, so no digit is lost: a few roundings of each elementary function.
    np.testing.assert_allclose(J, expected, rtol=1e-13, atol=1e-14)
    J, expected = np.empty((2, 3)), np.empty((2, 3))
    complex_step(static["h_complex"][0], True, x, U, P, 0.0, J, scratch)
    H(x, U, P, expected)
    np.testing.assert_allclose(J, expected, rtol=1e-13, atol=1e-14)


def track(model):
    rng = np.random.default_rng(0)
    rows = [(0.02 * k, READING, rng.normal((0.18, -0.66), 0.1)) for k in range(40)]
    return folded("ekf", model, log_of(2, *rows)).track


def test_the_filter_says_the_same_with_the_models_own_jacobians():
    assert compile_model(model(F=F, H=H)).static["F_mode"] == ANALYTIC
    stepped, analytic = track(model()), track(model(F=F, H=H))
    assert np.all(np.isfinite(analytic.mean))
    np.testing.assert_allclose(stepped.mean, analytic.mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(stepped.std, analytic.std, rtol=1e-10)


@pytest.mark.parametrize("f", [saturated, silently_wrong])
def test_f_that_is_not_analytic_falls_back_to_differences(f):
    assert compile_model(model(f=f)).static["F_mode"] == CENTRAL


def test_h_that_is_not_analytic_falls_back_to_differences():
    static = compile_model(model(h=magnitude)).static
    assert static["H_mode"][0] == CENTRAL
    assert static["F_mode"] == COMPLEX_STEP


def test_differences_are_good_enough():
    """The same smooth model, kept from complex numbers by a comparison that is always true."""

    def compared(x, u, p, dt, out):
        a = x[0] if x[0] > -1e300 else 0.0
        out[0] = a + dt * (x[1] * x[2] + p[0] * np.exp(-a * a))
        out[1] = x[1] * np.cos(a) - dt * p[1] * np.sqrt(x[2]) + u[0]
        out[2] = 1.0 + 0.3 * np.sqrt(x[2]) / (1.0 + a**2) + dt * np.tanh(x[1])

    assert compile_model(model(f=compared)).static["F_mode"] == CENTRAL
    # Truncation step²/6·f''' and rounding ε/step are both about 1e-11 here; the fold multiplies it by tens.
    np.testing.assert_allclose(track(model(f=compared)).mean, track(model()).mean, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", list(MODELS))
def test_models_that_ship_are_analytic_or_say_why(name):
    """The EKF's cost and digits depend on it: a model that ships does not slip into differences unseen."""
    if MODELS[name].shape is not None:
        pytest.skip("a field that only ensembles estimate: no filter asks for its derivatives")
    static = compile_model(MODELS[name]).static
    assert static["F_mode"] != CENTRAL


def hold(x, u, p, dt, out):
    out[0] = x[0]


def scaled(x, u, p, out):
    out[0] = p[0] * x[0]


@pytest.mark.parametrize("estimator", ["kf", "ekf", "sr-kf"])
def test_h_of_a_linear_model_is_that_of_the_parameters_in_use(estimator):
    """H is computed once per tuning: y = p x of x ~ N(1, 4) with noise 0.25 has the variance 4 p² + 0.25."""
    model = StateSpaceModel(
        name="scaled",
        title="scaled",
        states=(State("x", "1", mean=1.0, std=2.0),),
        noises=(Noise("x", "1/s", variance=0.01),),
        sensors=(Sensor("y", (Row("y", "1", 0.25),), h=scaled),),
        f=hold,
        parameters=(Parameter("gain", "1", 2.0),),
        linear=True,
    )
    for gain in (2.0, 5.0):
        track = fold(estimator, model, Tuning.of(model).set("p.gain", gain), log_of(1, (0, READING, 3.0)))
        S = 4.0 * gain**2 + 0.25
        assert track.innovation_std[0, 0] == pytest.approx(np.sqrt(S), rel=1e-12)
        assert track.mean[0, 0] == pytest.approx(1.0 + 4.0 * gain / S * (3.0 - gain), rel=1e-12)


def stopped(x, u, p, dt, out):
    out[0] = x[0]
    out[1] = 0.0


def shared_flow(x, u, p, out):
    out[0] = x[0] / x[1]


def test_a_derivative_that_divides_by_zero_ends_no_fold():
    """The derivative with respect to the first state has the second as divisor, which has no imaginary part there."""
    model = StateSpaceModel(
        name="shares", title="shares", f=stopped,
        states=(State("flow", "1", 1.0, 1.0), State("pumps", "1", 1.0, 1.0)),
        noises=(Noise("flow", "1/s", 1.0),), sensors=(Sensor("share", (Row("share", "1", 1.0),), h=shared_flow),),
    )  # fmt: skip
    H = np.zeros((1, 2))
    target = compile_model(model).static["h_complex"][0]
    complex_step(target, True, np.array([1.0, 0.0]), np.empty(0), np.empty(0), 0.0, H, np.empty(scratch_size(2, 1)))
    assert np.isnan(H[0, 0])
    log = measured(model, "share", [1.0, 2.0], [0.5, 0.5], start=0.0)
    verdicts = fold("ekf", model, Tuning.of(model), log).verdict
    assert verdicts.tolist() == [FAILED, FAILED]
