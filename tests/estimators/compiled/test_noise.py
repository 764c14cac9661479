"""Process and sensor noise: roots of covariances, noise that depends on the state, and steps in which it adds up."""

import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from estimators import registry
from estimators.compiled.context import SLACK, steps_of
from estimators.compiled.noise import add_noise, belief_root, has_correlated_rows, independent_rows, semidefinite_root
from estimators.errors import ModelError
from estimators.fold import Fold, fold
from estimators.log import TICK, Events, Log
from estimators.model.parts import correlation_of, covariance_of
from estimators.model.state_space import Row, Sensor
from estimators.tuning import Tuning
from sources.simulator import Simulator
from tests.cases import cases
from tests.estimators.linear_models import random_linear
from tests.estimators.test_fold import in_python
from tests.models import level_model
from tests.support import SECOND, as_log, log_of, read_all


def root(A):
    L = np.full_like(A, np.nan)
    return semidefinite_root(A, L), L


@pytest.mark.parametrize("n", [1, 2, 5, 12])
@pytest.mark.parametrize("lost", [0, 1, 3])
def test_a_root_of_any_rank(n, lost):
    rng = np.random.default_rng(n)
    B = rng.standard_normal((n, max(0, n - lost)))
    A = B @ B.T
    fine, L = root(A)
    assert fine
    assert np.array_equal(L, np.tril(L))
    # Directions whose pivot is below 1e-13 n of the diagonal are dropped: an error of its root at most.
    assert np.max(np.abs(L @ L.T - A), initial=0) <= 1e-6 * max(np.max(np.abs(A), initial=0), 1e-300)


def test_integrated_white_noise_and_zero():
    dt = 1e-3
    A = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    fine, L = root(A)
    assert fine and np.allclose(L @ L.T, A, rtol=1e-12)
    fine, L = root(np.zeros((3, 3)))
    assert fine and np.all(L == 0)


@cases(__file__, "no_covariances.csv")
def test_what_is_no_covariance_is_refused_visibly(A):
    """The second of three has no variance but the first one's, of which the third knows nothing: eigenvalue -0.005."""
    fine, L = root(np.array(json.loads(A)))
    assert not fine and np.all(np.isnan(L))


def test_variances_near_the_smallest_numbers_have_a_root():
    """A cloud that resampling made of near-copies of one particle: products of its variances are below all numbers."""
    v = np.array([8.1e-282, -1.5e-282, -1.5e-284])
    A = np.outer(v, v) / 1e-281
    fine, L = root(A)
    assert fine and np.allclose(L @ L.T, A, rtol=1e-6, atol=0.0)


def test_a_belief_that_rounding_made_indefinite_keeps_its_deviations():
    A = np.array([[4.0, 2.0 + 1e-3], [2.0 + 1e-3, 1.0]])
    L = np.full((2, 2), np.nan)
    belief_root(A, L)
    assert np.array_equal(L, np.diag([2.0, 1.0]))
    belief_root(np.eye(2) * 9.0, L)
    assert np.array_equal(L, 3.0 * np.eye(2))


def test_noise_is_added_through_the_whole_lower_triangle():
    L = np.array([[2.0, 9.0, 9.0], [3.0, 5.0, 9.0], [-1.0, 4.0, 7.0]])
    x = np.array([10.0, 20.0, 30.0])
    add_noise(L, np.array([1.0, 10.0, 100.0]), x)
    np.testing.assert_array_equal(x, [12.0, 73.0, 769.0])


C = ((1.0, 0.6, -0.3), (0.6, 1.0, 0.2), (-0.3, 0.2, 1.0))


def thrice(x, u, p, out):
    out[0] = x[0]
    out[1] = 2.0 * x[0]
    out[2] = -x[0]


def model(correlation):
    rows = tuple(Row(name, "m", variance) for name, variance in (("a", 0.5), ("b", 2.0), ("c", 1e-3)))
    three = Sensor("three", rows, h=thrice, correlation=correlation)
    one = level_model({"one": 1.0}, 1e-3, state="x", name="three", linear=True)
    return replace(one, sensors=(*one.sensors, three))


@pytest.fixture(scope="module")
def context():
    declared = model(C)
    fold = Fold("kf", declared, Tuning.of(declared), Log(declared.width))
    yield fold.machine.context
    del fold


@pytest.mark.parametrize("there", [[0], [1], [2], [0, 1], [0, 2], [1, 2], [0, 1, 2]])
@pytest.mark.parametrize("r", [[0.5, 2.0, 1e-3], [3e-200, 1e-190, 2.0], [0.5, 0.0, 2.0], [0.0, 1.0, 2.0]])
def test_r_of_the_rows_that_are_there(context, there, r):
    y, r = np.full(3, np.nan), np.array(r)
    y[there] = 1.0
    L, d = np.full((3, 3), np.nan), np.full(3, np.nan)
    m = independent_rows(context, 1, y, r, L, d)
    assert m == len(there) and has_correlated_rows(context, 1) and not has_correlated_rows(context, 0)
    L = np.tril(L[:m, :m], -1) + np.eye(m)
    # The oracle: R by its definition, in the units of each row's deviation.
    scale = np.where(r[there] > 0.0, np.sqrt(r[there]), 1.0)
    R = np.array(C)[np.ix_(there, there)] * np.outer(*[np.sqrt(r[there]) / scale] * 2)
    root = (L / scale[:, None]) * np.sqrt(d[:m])
    np.testing.assert_allclose(root @ root.T, R, rtol=0, atol=1e-14)


def test_independent_rows_keep_their_variances(context):
    L, d = np.full((1, 1), np.nan), np.empty(1)
    assert independent_rows(context, 0, np.array([1.0]), np.array([7.0]), L, d) == 1
    assert d[0] == 7.0 and np.isnan(L[0, 0])


def test_a_covariance_and_its_correlation():
    R = np.array([[4.0, 1.0], [1.0, 0.25]]) + np.diag([0.0, 1.0])
    c = correlation_of(R)
    np.testing.assert_allclose(covariance_of(c, np.diag(R)), R, rtol=1e-15)
    np.testing.assert_array_equal(covariance_of(None, np.diag(R)), np.diag(np.diag(R)))


def test_a_sensor_holds_any_matrix_so_that_models_compare():
    assert model(np.array(C)) == model(C) and hash(model(np.array(C))) == hash(model(C))
    assert model(C) != model(None)


@cases(__file__, "no_correlations.csv")
def test_what_is_no_correlation_is_refused(correlation, message):
    with pytest.raises(ModelError, match=rf"model three: the correlation of sensor three .*{message}"):
        model(json.loads(correlation))


def test_the_simulator_draws_correlated_noise():
    declared = model(C)
    events = read_all(
        Simulator(declared, seed=1, step=1.0, duration=4000.0, initial={"x": 0.0}, truth_noise={"x": 0.0})
    )
    y = events.value[events.of_sensor(1), :3]
    R = covariance_of(C, np.array([0.5, 2.0, 1e-3]))
    # A sample covariance of N draws has the standard deviation √((R_ii R_jj + R_ij²) / N).
    spread = np.sqrt((np.outer(np.diag(R), np.diag(R)) + R**2) / len(y))
    assert np.all(np.abs(np.cov(y.T) - R) < 4.0 * spread)


def double(x, u, p, dt, out):
    out[0] = 2.0 * x[0]


def relative(x, u, p, q, dt, out):
    out[0, 0] = q[0] * dt * x[0] * x[0]


@pytest.mark.parametrize("estimator", ["ekf", "iekf", "ukf", "ckf", "sr-ekf", "sr-ukf", "filterpy-ekf", "filterpy-ukf"])
def test_noise_is_that_of_the_state_before_the_step(estimator):
    """x = 3 ± 0.5 doubles in 1 s with Q = 0.1 x²: P = 4·0.25 + 0.1·9, not 0.1·36."""
    model = level_model({"y": 1.0}, 0.1, state="x", mean=3.0, std=0.5, f=double, Q=relative)
    track = fold(estimator, model, Tuning.of(model), log_of(1, (0, TICK, []), (1, TICK, [])))
    np.testing.assert_allclose(track.mean[1, 0], 6.0, rtol=1e-14)
    np.testing.assert_allclose(track.std[1, 0] ** 2, 1.9, rtol=1e-13)


@pytest.mark.parametrize("exponent", range(-9, 10))
def test_whole_multiples_at_all_magnitudes(exponent):
    """k steps of d·10^e seconds take k steps: by ceil of the quotient, one in ten took one more."""
    for digit in (1, 2, 3, 5, 6, 7, 9):
        step = float(Fraction(digit) * Fraction(10) ** exponent)
        for k in (1, 2, 3, 6, 7, 11, 13, 100, 999, 10_000):
            assert steps_of(float(Fraction(k) * Fraction(digit) * Fraction(10) ** exponent), step) == k
            assert steps_of(k * step, step) == k
    assert steps_of(0.3, 0.1) == 3


def test_timestamps_in_whole_nanoseconds():
    for hertz in (3, 7, 30, 60, 1000 / 3, 30_000):
        for k in (1, 2, 3, 50):
            for begun in (0.0, 1.7e9):
                first = round(begun * 1e9)
                last = first + round(k * 1e9 / hertz)
                assert steps_of((last - first) * 1e-9, 1.0 / hertz) == k


@pytest.mark.parametrize("seed", range(3))
def test_no_step_is_longer_than_allowed_and_none_is_wasted(seed):
    rng = np.random.default_rng(seed)
    for _ in range(2000):
        step = float(10 ** rng.uniform(-6, 6))
        dt = step * float(10 ** rng.uniform(-3, 4))
        n = steps_of(dt, step)
        assert dt / n <= step * (1 + SLACK) and (n == 1 or dt > step * (n - 1))
    assert steps_of(5.0, np.inf) == 1 and steps_of(0.0, 1.0) == 1


@pytest.mark.parametrize("name", ["ekf", "ekf-python"])
def test_the_fold_crosses_a_gap_in_as_many_steps(name, monkeypatch):
    """x' = x + A x dt is Euler's rule, so the number of steps shows in the mean: (1 + A dt/3)³."""
    monkeypatch.setitem(registry.ESTIMATORS, "ekf-python", in_python("ekf"))
    matrices = random_linear(np.random.default_rng(1), 3, 2)
    model = replace(matrices.model, max_step=0.1)
    ticks = [Events.one(t, 0, TICK, 0, (), model.width) for t in (0, 3 * SECOND // 10)]
    track = fold(name, model, Tuning.of(model), as_log(Events.concat(ticks, model.width)))
    x = matrices.mean
    for _ in range(3):
        x = x + 0.1 * (matrices.A @ x + matrices.B @ matrices.u)
    np.testing.assert_allclose(track.mean[1], x, rtol=1e-13)
