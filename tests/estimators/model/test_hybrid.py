"""Hybrid models: corrections against scikit-learn and closed forms, and against physics that has them written in."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from estimators.compiled.model import compile_model
from estimators.errors import ModelError
from estimators.fold import fold
from estimators.log import Log
from estimators.model.assemble import JointParameter, joint
from estimators.model.coloured import coloured
from estimators.model.correction import GaussianProcess, Net, Ridge
from estimators.model.hybrid import LearnedCorrection, hybrid
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.tuning import Tuning
from tests.models import complex_step, second_state
from tests.support import folded

RNG = np.random.default_rng(3)
POINTS = RNG.normal((60.0, 10.0, -2.0), (10.0, 3.0, 0.5), (24, 3))
RATES = RNG.normal(0.0, 0.1, (24, 2))
FEATURES = ("body", "shell", "load")
"""Two states and an input."""

CORRECTIONS = {
    "gp": GaussianProcess(POINTS, RATES, np.array([15.0, 4.0, 0.8]), 0.7),
    "ridge": Ridge(POINTS, RATES, 3.0),
    "ridge of degree 2": Ridge(POINTS, RATES, 3.0, 2),
}


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * (p[0] * (x[1] - x[0]) + u[0])
    out[1] = x[1] + dt * (0.02 * (x[0] - x[1]) - 0.01 * x[1])


def F(x, u, p, dt, out):
    out[0, 0] = 1.0 - dt * p[0]
    out[0, 1] = dt * p[0]
    out[1, 0] = dt * 0.02
    out[1, 1] = 1.0 - dt * 0.03


PHYSICS = StateSpaceModel(
    name="vessel",
    title="A body in a shell",
    states=(State("body", "°C", mean=60.0, std=5.0), State("shell", "°C", mean=10.0, std=2.0)),
    inputs=(Input("load", "W", default=-2.0),),
    parameters=(Parameter("loss", "1/s", 0.05, 0.01, 0.5),),
    noises=(Noise("body", "°C²/s", 0.02), Noise("shell", "°C²/s", 0.01)),
    sensors=(Sensor("gauge", (Row("gauge", "°C", 0.04),), h=second_state),),
    f=f,
    F=F,
    linear=True,
    max_step=1.0,
)

PLACES = RNG.normal((60.0, 10.0, -2.0), (12.0, 4.0, 0.7), (40, 3))
"""Where corrections are asked: among their points and beyond."""


def learned(correction, corrects=("body", "shell"), features=FEATURES):
    return LearnedCorrection(corrects, features, (0.3, 0.5)[: len(corrects)], correction)


def called(model, place, dt=0.5):
    """f, Q and their compiled forms at one place: next state, covariance."""
    compiled = compile_model(model)
    x, u = np.array(place[:2]), np.array(place[2:])
    p = model.default_parameters
    q = np.array([noise.variance for noise in model.noises])
    out, Q = np.empty(2), np.zeros((2, 2))
    compiled.f(x, u, p, dt, out)
    compiled.Q(x, u, p, q, dt, Q)
    return out, Q


def test_a_gaussian_process_is_that_of_scikit_learn():
    process = pytest.importorskip("sklearn.gaussian_process")
    given = CORRECTIONS["gp"]
    amplitude = 0.37  # what it is multiplied by changes no mean, and is what a share is a share of
    kernel = process.kernels.ConstantKernel(amplitude, "fixed") * process.kernels.RBF(given.lengths, "fixed")
    peer = process.GaussianProcessRegressor(kernel, alpha=amplitude * given.ratio, optimizer=None).fit(POINTS, RATES)
    mean, std = peer.predict(PLACES, return_std=True)
    np.testing.assert_allclose(given.mean(PLACES), mean, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(given.share(PLACES), std[:, 0] ** 2 / amplitude, rtol=0.0, atol=1e-9)
    assert 0.0 < given.share(PLACES).min() < 0.5 < given.share(PLACES).max() < 1.0


@pytest.mark.parametrize("degree", [1, 2])
def test_a_ridge_is_that_of_scikit_learn_where_it_is_believed(degree):
    linear = pytest.importorskip("sklearn.linear_model")
    from sklearn.preprocessing import PolynomialFeatures

    given = Ridge(POINTS, RATES, 3.0, degree)
    phi = PolynomialFeatures(degree)
    scaled = (POINTS - POINTS.mean(axis=0)) / POINTS.std(axis=0)
    peer = linear.Ridge(alpha=3.0, fit_intercept=False).fit(phi.fit_transform(scaled), RATES)
    np.testing.assert_allclose(given.mean(POINTS), peer.predict(phi.transform(scaled)), rtol=0.0, atol=1e-9)


def test_the_share_of_a_ridge_is_what_is_left_of_the_belief_in_its_weights():
    given, lam = Ridge(POINTS, RATES, 3.0), 3.0
    phi = np.column_stack((np.ones(24), (POINTS - POINTS.mean(axis=0)) / POINTS.std(axis=0)))
    # w ~ N(0, I / λ) beside windows of variance 1: the covariance of w given them, by the matrix inversion lemma.
    left = np.eye(4) / lam - phi.T / lam @ np.linalg.inv(phi @ phi.T / lam + np.eye(24)) @ phi / lam
    prior = np.mean(np.sum(phi**2, axis=1)) / lam
    np.testing.assert_allclose(given.share(POINTS), np.sum(phi @ left * phi, axis=1) / prior, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("kind", CORRECTIONS)
def test_compiled_as_written(kind):
    correction = CORRECTIONS[kind]
    model = hybrid(PHYSICS, learned(correction))
    for place, mean, share in zip(PLACES, correction.mean(PLACES), correction.share(PLACES), strict=True):
        (x, Q), (physics, Q_physics) = called(model, place), called(PHYSICS, place)
        np.testing.assert_allclose(x, physics + 0.5 * mean, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(Q, Q_physics + 0.5 * share * np.diag((0.3, 0.5)), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("kind", CORRECTIONS)
@pytest.mark.parametrize("analytic", [True, False])
def test_slopes_are_those_of_the_step(kind, analytic):
    model = hybrid(PHYSICS if analytic else replace(PHYSICS, F=None), learned(CORRECTIONS[kind]))
    compiled = compile_model(model)
    p = np.array([0.05])
    for place in PLACES[:8]:
        u = np.array(place[2:])

        def step(x, u=u):
            out = np.empty(2)
            compiled.f(x, u, p, 0.5, out)
            return out

        expected = approx_fprime(np.array(place[:2]), step, 1e-6)
        found = np.empty((2, 2))
        if analytic:
            model.F(np.array(place[:2]), u, p, 0.5, found)
        else:
            own = np.array(place[:2], float)
            found = complex_step(lambda z, out, u=u: model.f(z, u.astype(float), p, 0.5, out), own, 2)
        # Forward differences with a step of 1e-6 of numbers of about 60 are good to 1e-7.
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("kind", CORRECTIONS)
def test_far_from_its_points_it_is_the_physics_and_knows_nothing(kind):
    correction = CORRECTIONS[kind]
    far = POINTS.mean(axis=0) + 40.0 * POINTS.std(axis=0) * np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [1, 1, 1]])
    model = hybrid(PHYSICS, learned(correction))
    for place in far:
        (x, Q), (physics, Q_physics) = called(model, place), called(PHYSICS, place)
        np.testing.assert_allclose(x, physics, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(Q - Q_physics, 0.5 * np.diag((0.3, 0.5)), rtol=0.0, atol=1e-6)


def log_of(model, seconds=60):
    log = Log.of(model)
    t = np.arange(0.0, seconds, 0.5)
    log.add_inputs(t, load=-2.0 + np.sin(t / 7.0))
    log.add("gauge", t, 10.0 + np.sin(t / 5.0))
    return log


def line(z):
    return np.column_stack((0.02 * z[:, 0] - 0.1 * z[:, 1] + 0.3 * z[:, 2] - 1.0, -0.01 * z[:, 0] + 0.05 * z[:, 2]))


def f_with_line(x, u, p, dt, out):
    out[0] = x[0] + dt * (p[0] * (x[1] - x[0]) + u[0]) + dt * (0.02 * x[0] - 0.1 * x[1] + 0.3 * u[0] - 1.0)
    out[1] = x[1] + dt * (0.02 * (x[0] - x[1]) - 0.01 * x[1]) + dt * (-0.01 * x[0] + 0.05 * u[0])


WIDE = 1e4 * np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
"""Points so far apart that a net is believed wherever a test goes."""


@pytest.mark.parametrize("name", ["filterpy-ekf", "filterpy-ukf", "enkf", "pf"])
def test_a_net_beside_the_physics_is_the_physics_that_has_it(name):
    model = hybrid(PHYSICS, learned(Net(WIDE, line)))
    assert model.black_box
    peer = replace(PHYSICS, f=f_with_line, F=None)
    options = {"particles": 200} if name == "pf" else {"members": 50} if name == "enkf" else {}
    tracks = []
    for each in (model, peer):
        tuning = Tuning.of(each).with_options(options)
        if each is model:
            tuning = tuning.set("Q.body_learned", 0.0).set("Q.shell_learned", 0.0)
        tracks.append(fold(name, each, tuning, log_of(each)))
    # The same operations but for their order in a sum; slopes of a black box are differences, good to 1e-10 a step.
    tolerance = 1e-7 if name == "filterpy-ekf" else 1e-9
    np.testing.assert_allclose(tracks[0].mean, tracks[1].mean, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(tracks[0].std, tracks[1].std, rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("name", ["ekf", "ukf", "filterpy-ekf"])
def test_filters_that_are_compiled_see_what_filterpy_sees(name):
    model = hybrid(PHYSICS, learned(CORRECTIONS["gp"]))
    own, peer = (folded(each, model, log_of(model)).track for each in (name, "filterpy-ekf"))
    plain = folded("ekf", PHYSICS, log_of(PHYSICS)).track
    # The UKF's mean of a curved f is another one; what the correction does is a hundred times as much.
    tolerance = 0.05 if name == "ukf" else 1e-9
    assert np.max(np.abs(own.mean - peer.mean)) < tolerance
    assert np.max(np.abs(own.mean - plain.mean)) > 0.5


def test_it_goes_with_noise_that_lasts_and_with_parameters_that_are_estimated():
    corrected = hybrid(PHYSICS, learned(CORRECTIONS["gp"]))
    model = joint(coloured(corrected, {"shell": 4.0}), {"loss": JointParameter(0.01)})
    assert model.state_names == ("body", "shell", "shell_disturbance", "loss")
    compiled = compile_model(model)
    place = PLACES[0]
    x, u = np.array([place[0], place[1], 0.2, 0.05]), np.array(place[2:])
    p = model.default_parameters
    out = np.empty(4)
    compiled.f(x, u, p, 0.5, out)
    expected, Q_corrected = called(corrected, place)
    expected[1] += 4.0 * -math.expm1(-0.5 / 4.0) * 0.2  # the integral of the disturbance
    np.testing.assert_allclose(out[:2], expected, rtol=0.0, atol=1e-12)
    Q = np.zeros((4, 4))
    compiled.Q(x, u, p, np.array([noise.variance for noise in model.noises]), 0.5, Q)
    assert Q[0, 0] == pytest.approx(Q_corrected[0, 0], abs=1e-12)
    assert Q[1, 1] < Q_corrected[1, 1]


def test_a_black_box_is_corrected_too():
    def block(X, u, p, dt):
        return np.stack((X[:, 0] + dt * (p[0] * (X[:, 1] - X[:, 0]) + u[0]),
                         X[:, 1] + dt * (0.02 * (X[:, 0] - X[:, 1]) - 0.01 * X[:, 1])), axis=1)  # fmt: skip

    box = replace(
        PHYSICS, f=block, F=None, sensors=(replace(PHYSICS.sensors[0], h=lambda X, u, p: X[:, 1:]),),
        black_box=True, linear=False,
    )  # fmt: skip
    tracks = [
        folded("filterpy-ekf", model, log_of(model)).track
        for model in (hybrid(box, learned(CORRECTIONS["gp"])), hybrid(PHYSICS, learned(CORRECTIONS["gp"])))
    ]
    # Slopes of a black box are central differences.
    np.testing.assert_allclose(tracks[0].mean, tracks[1].mean, rtol=0.0, atol=1e-6)


def test_a_linear_model_stays_linear_only_where_no_state_is_a_feature():
    by_load = LearnedCorrection(("body",), ("load",), (0.1,), Ridge(POINTS[:, 2:], RATES[:, :1], 1.0))
    assert hybrid(PHYSICS, by_load).linear
    assert not hybrid(PHYSICS, learned(CORRECTIONS["gp"])).linear


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"corrects": ("bdy", "shell")}, "has no state 'bdy'; did you mean body?"),
        ({"features": ("body", "shell", "laod")}, "has no state or input 'laod'; did you mean load?"),
        ({"features": ("body", "body", "load")}, "names body twice"),
        ({"corrects": ()}, "names no state"),
    ],
)
def test_names_are_checked(change, said):
    with pytest.raises(ModelError, match=said.replace("?", r"\?")):
        hybrid(PHYSICS, replace(learned(CORRECTIONS["gp"]), **change))


def test_what_cannot_be_corrected_is_refused():
    angle = replace(PHYSICS, states=(replace(PHYSICS.states[0], circular=True), PHYSICS.states[1]))
    with pytest.raises(ModelError, match="body is an angle, which cannot be a feature"):
        hybrid(angle, learned(CORRECTIONS["gp"]))
    with pytest.raises(ModelError, match="has a noise body_learned already"):
        hybrid(hybrid(PHYSICS, learned(CORRECTIONS["gp"])), learned(CORRECTIONS["gp"]))
