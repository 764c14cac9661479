"""Models from matrices against SciPy's discretisation, quadrature, and a dense Kalman recursion in NumPy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm
from scipy.signal import cont2discrete

from estimators import Log, fold
from estimators.compiled.model import compile_model
from estimators.errors import ModelError
from estimators.model.linear import linear_model
from estimators.model.state_space import Input, Row, State, StateSpaceModel

NONE = np.zeros(0)


def made(A, B, C, D, sample_time: float = 0.0) -> StateSpaceModel:
    ny = len(C)
    return linear_model(
        "m", A, B, C, D,
        states=[State(f"x{k}", "1", 0.1 * k, 1.0 + k) for k in range(len(A))],
        inputs=[Input(f"u{k}", "1") for k in range(np.shape(B)[1])],
        sensors=[("first", [Row("y0", "1", 0.1)]), ("rest", [Row(f"y{k}", "1", 0.2) for k in range(1, ny)])],
        variances=0.1 + 0.1 * np.arange(len(A)),
        sample_time=sample_time,
    )  # fmt: skip


def matrices(seed: int, nx: int = 3, nu: int = 2, ny: int = 3) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(nx, nx)) - 1.5 * np.eye(nx)
    return A, rng.normal(size=(nx, nu)), rng.normal(size=(ny, nx)), rng.normal(size=(ny, nu))


@pytest.fixture(scope="module")
def model() -> StateSpaceModel:
    return made(*matrices(1))


@pytest.mark.parametrize("dt", [0.0, 1e-9, 0.01, 0.37, 5.0, 80.0])
def test_steps_of_any_length_are_those_of_scipy(model, dt):
    A, B, C, D = matrices(1)
    compiled = compile_model(model)
    x, u = np.array([1.0, -2.0, 3.0]), np.array([0.5, -1.5])
    Ad, Bd = (np.eye(3), np.zeros((3, 2))) if dt == 0.0 else cont2discrete((A, B, C, D), dt)[:2]
    after, F, Q = np.empty(3), np.empty((3, 3)), np.zeros((3, 3))
    compiled.f(x, u, NONE, dt, after)
    model.F(x, u, NONE, dt, F)
    # Both exponentials round at ε of the size of their terms.
    np.testing.assert_allclose(F, Ad, atol=1e-13)
    np.testing.assert_allclose(after, Ad @ x + Bd @ u, atol=1e-12)
    q = np.array([0.3, 0.0, 2.0])
    compiled.Q(x, u, NONE, q, dt, Q)
    expected = quad_vec(lambda s: expm(A * s) @ np.diag(q) @ expm(A * s).T, 0.0, dt, epsabs=1e-13, epsrel=1e-12)[0]
    np.testing.assert_allclose(Q, expected, atol=1e-11, rtol=1e-9)
    assert np.array_equal(Q, Q.T)
    for k, own in enumerate((slice(0, 1), slice(1, 3))):
        y = np.empty(own.stop - own.start)
        compiled.h[k](x, u, NONE, y)
        np.testing.assert_allclose(y, (C @ x + D @ u)[own], atol=1e-14)


def test_fast_modes_do_not_overflow():
    """Van Loan's block matrix would hold e^(1e5)."""
    model = made(np.diag([-1e5, -1.0]), np.zeros((2, 0)), np.eye(2), np.zeros((2, 0)))
    Q = np.zeros((2, 2))
    model.Q(np.zeros(2), NONE, NONE, np.ones(2), 1.0, Q)
    np.testing.assert_allclose(Q, np.diag([0.5e-5, 0.5 * -np.expm1(-2.0)]), rtol=1e-12)


def test_the_kalman_filter_is_that_of_a_dense_recursion(model):
    A, B, C, D = matrices(1)
    rng = np.random.default_rng(2)
    times = np.cumsum(rng.uniform(0.05, 0.7, 60))
    inputs, ys = rng.normal(size=(60, 2)), rng.normal(size=(60, 3))
    log = Log.of(model, start=0.0)
    log.add_inputs(times, u0=inputs[:, 0], u1=inputs[:, 1])
    log.add("rest", times, ys[:, 1:])
    run = fold("kf", model, log, covariance=True)
    times = np.round(times * 1e9) / 1e9
    m, P, u, last = model.prior_mean, model.prior_cov, np.zeros(2), 0.0
    R, q = 0.2 * np.eye(2), np.array([noise.variance for noise in model.noises])
    for t, now, y in zip(times, inputs, ys[:, 1:], strict=True):
        dt, last = t - last, t
        whole = expm(np.block([[A, B], [np.zeros((2, 5))]]) * dt)
        F, G = whole[:3, :3], whole[:3, 3:]
        loan = expm(np.block([[-A, np.diag(q)], [np.zeros((3, 3)), A.T]]) * dt)
        m, P = F @ m + G @ u, F @ P @ F.T + F @ loan[:3, 3:]
        u = now
        S = C[1:] @ P @ C[1:].T + R
        K = np.linalg.solve(S, C[1:] @ P).T
        m, P = m + K @ (y - C[1:] @ m - D[1:] @ u), P - K @ S @ K.T
        row = np.flatnonzero(np.abs(run.seconds - t) < 1e-9)[-1]
        np.testing.assert_allclose(run.mean[row], m, atol=1e-11)
        np.testing.assert_allclose(run.cov[row], P, atol=1e-11)


DISCRETE = {
    "stable": (np.array([[0.9, 0.2], [-0.2, 0.8]]), np.array([[0.1], [1.0]])),
    "double integrator": (np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])),
}


@pytest.mark.parametrize("name", DISCRETE)
def test_a_discrete_model_has_its_own_states_at_its_samples(name):
    A, B = DISCRETE[name]
    model = made(A, B, np.eye(2), np.zeros((2, 1)), sample_time=0.1)
    x, u, after = np.array([1.0, -2.0]), np.array([3.0]), np.empty(2)
    expected = x
    for k in range(1, 8):
        expected = A @ expected + B @ u
        model.f(x, u, NONE, 0.1 * k, after)
        # The logarithm of a matrix with a double eigenvalue is good to √ε of ε's neighbourhood: some 1e-13 here.
        np.testing.assert_allclose(after, expected, atol=1e-11)
    half = np.empty(2)
    model.f(x, u, NONE, 0.05, half)
    model.f(half, u, NONE, 0.05, after)
    np.testing.assert_allclose(after, A @ x + B @ u, atol=1e-12)


@pytest.mark.parametrize(
    ("A", "says"),
    [
        (np.diag([0.5, 0.0]), "A has the eigenvalue 0, a delay.*between its samples of 0.1 s.*give a continuous model"),
        (np.diag([0.5, -0.5]), "A has the eigenvalue -0.5, a mode that changes its sign at each sample"),
    ],
)
def test_a_discrete_model_without_a_continuous_form_is_refused(A, says):
    with pytest.raises(ModelError, match=says):
        made(A, np.zeros((2, 0)), np.eye(2), np.zeros((2, 0)), sample_time=0.1)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"A": np.eye(2)}, r"A has shape \(2, 2\); 3 states, 2 inputs and 3 rows of sensors need \(3, 3\)"),
        ({"B": np.ones((3, 1))}, r"B has shape \(3, 1\)"),
        ({"C": np.full((3, 3), np.nan)}, "C has entries that are not finite"),
        ({"sample_time": -1.0}, "the sample time is -1 s; it must be zero or positive"),
    ],
)
def test_what_does_not_fit_is_one_line(change, says):
    given = dict(zip("ABCD", matrices(1), strict=True)) | {"sample_time": 0.0} | change
    names = [State(f"x{k}", "1") for k in range(3)], [Input(f"u{k}", "1") for k in range(2)]
    sensors = [("all", [Row(f"y{k}", "1", 1.0) for k in range(3)])]
    with pytest.raises(ModelError, match=says):
        linear_model("m", *(given[k] for k in "ABCD"), states=names[0], inputs=names[1], sensors=sensors,
                     sample_time=given["sample_time"])  # fmt: skip


def test_the_same_matrices_are_compiled_once():
    assert made(*matrices(1)) == made(*matrices(1))
    assert replace(made(*matrices(1)), f=None) != replace(made(*matrices(2)), f=None)
