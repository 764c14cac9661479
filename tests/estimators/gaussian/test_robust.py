"""Inflation, robust weights and adaptation, in every Gaussian filter, against numbers worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from estimators.fold import Fold
from estimators.log import READING, Events
from estimators.model.state_space import Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.registry import ESTIMATORS
from estimators.track import GATED, USED
from estimators.tuning import Tuning
from tests.estimators.linear_models import ROWS, random_linear
from tests.models import level_model, unchanged
from tests.support import SECOND, as_log, log_of

NAMES = [name for name, entry in ESTIMATORS.items() if entry.family == "Gaussian" and name != "kf-steady"]
P, R = 4.0, 0.25


@pytest.fixture(params=NAMES)
def estimator(request):
    return request.param


def mixed(x, u, p, out):
    out[0] = x[0] + 0.5 * x[1]
    out[1] = x[1] - x[0]


def model(*, q=0.0, p=P, r=R, max_step=np.inf):
    return level_model({"y": r}, q, state="x", std=np.sqrt(p), linear=True, max_step=max_step)


PLANE = StateSpaceModel(
    name="plane",
    title="two states, two rows",
    states=(State("a", "m", std=2.0), State("b", "m", std=1.0)),
    noises=(Noise("a", "m²/s", variance=0.0),),
    sensors=(Sensor("y", (Row("y1", "m", variance=0.25), Row("y2", "m", variance=0.5)), h=mixed),),
    f=unchanged,
    linear=True,
)


def readings_of(values, *, step=1.0):
    """A log of one reading after the other, `step` seconds apart."""
    return log_of(np.size(values[0]), *((k * step, READING, value) for k, value in enumerate(values)))


def folded(estimator, model, values, options, *, step=1.0, gate=None):
    tuning = Tuning.of(model).with_options(options).set("gate", gate)
    fold = Fold(estimator, model, tuning, readings_of(values, step=step))
    fold.advance()
    return fold


@pytest.mark.parametrize(("step", "max_step"), [(2.0, np.inf), (2.0, 0.5), (0.25, np.inf)])
def test_inflation_is_a_rate_whatever_the_steps(estimator, step, max_step):
    """Without Q, P(2 s) = 3² P(0), in one step or in eight."""
    values = [np.nan] * (round(2.0 / step) + 1)
    fold = folded(estimator, model(max_step=max_step), values, {"inflation": 3.0}, step=step)
    np.testing.assert_allclose(fold.moments()[1][0, 0], 9.0 * P, rtol=1e-12)


def test_inflation_comes_before_q(estimator):
    """One step of 1 s: 2 · 4 + 0.3."""
    fold = folded(estimator, model(q=0.3), [np.nan, np.nan], {"inflation": 2.0})
    np.testing.assert_allclose(fold.moments()[1][0, 0], 8.3, rtol=1e-13)


@pytest.mark.parametrize("y", [7.0, -30.0, 1e4])
def test_huber_pulls_with_a_force_that_stops_growing(estimator, y):
    """Beyond the threshold x/P = ψ = k/√R, whatever y is: x⁺ = ± P k/√R, and y - x⁺ = (R/w) x⁺ / P gives w."""
    k = 0.7
    fold = folded(estimator, model(), [y], {"robust": 1, "huber": k})
    x = np.sign(y) * P * k / np.sqrt(R)
    noise = (y - x) * P / x  # R / w
    # The weight is iterated to 1e-12.
    np.testing.assert_allclose(fold.moments()[0][0], x, rtol=1e-10)
    np.testing.assert_allclose(fold.moments()[1][0, 0], P * noise / (P + noise), rtol=1e-10)
    # What the track says of the reading is what it would be without weights.
    np.testing.assert_allclose(fold.track.nis[0], y * y / (P + R), rtol=1e-13)


def test_huber_leaves_small_innovations_alone(estimator):
    """|y - x⁺| ≤ k √R up to |y| = k (P + R) / √R = 5.95: the plain filter's estimate."""
    for y in (0.0, 2.0, -5.9):
        fold = folded(estimator, model(), [y], {"robust": 1, "huber": 0.7})
        np.testing.assert_allclose(fold.moments()[0][0], P / (P + R) * y, rtol=1e-13, atol=1e-300)
        np.testing.assert_allclose(fold.moments()[1][0, 0], P * R / (P + R), rtol=1e-13)


@pytest.mark.parametrize("y", [(9.0, -6.0), (12.0, np.nan), (np.nan, 40.0)])
def test_huber_minimises_its_cost(estimator, y):
    """½ |x|²_P⁻¹ + ρ(|R^-½ (y - H x)|) over the rows that came, minimised by scipy."""
    k = 1.0
    H, r, p = np.array([[1.0, 0.5], [-1.0, 1.0]]), np.array([0.25, 0.5]), np.array([4.0, 1.0])
    finite = np.isfinite(y)

    def cost(x):
        d = np.linalg.norm((np.array(y) - H @ x)[finite] / np.sqrt(r[finite]))
        return 0.5 * np.sum(x * x / p) + (0.5 * d * d if d <= k else k * d - 0.5 * k * k)

    best = minimize(cost, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-15}).x
    fold = folded(estimator, PLANE, [y], {"robust": 1, "huber": k})
    plain = folded(estimator, PLANE, [y], {})
    assert np.max(np.abs(plain.moments()[0] - best)) > 0.1
    # A minimum is found to the root of the rounding of its cost.
    np.testing.assert_allclose(fold.moments()[0], best, atol=1e-6)


@pytest.mark.parametrize("y", [(0.5, 0.2), (9.0, -6.0), (np.nan, 40.0), (1e4, np.nan)])
def test_student_t_weighs_all_rows_by_one_precision(estimator, y):
    """w = (ν + m) / (ν + tr(R⁻¹ E e eᵀ)) with e = y - H x given noise R / w, by matrices, iterated from w = 1."""
    dof, w = 3.0, 1.0
    finite = np.isfinite(y)
    H = np.array([[1.0, 0.5], [-1.0, 1.0]])[finite]
    r, P, y_ = np.array([0.25, 0.5])[finite], np.diag([4.0, 1.0]), np.array(y)[finite]
    for _ in range(2000):
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(r / w))
        x, left = K @ y_, P - K @ H @ P
        e = y_ - H @ x
        w = (dof + r.size) / (dof + np.sum((e * e + np.diag(H @ left @ H.T)) / r))
    fold = folded(estimator, PLANE, [y], {"robust": 2, "dof": dof})
    np.testing.assert_allclose(fold.moments()[0], x, rtol=0, atol=1e-8)
    np.testing.assert_allclose(fold.moments()[1], left, rtol=0, atol=1e-8)


def test_the_level_of_q_follows_the_nis_of_a_row(estimator):
    """s = 1 + (NIS / m - 1) / N after one reading of m = 2 rows."""
    fold = folded(estimator, PLANE, [(3.0, -2.0)], {"adapt": 2, "memory": 50})
    H = np.array([[1.0, 0.5], [-1.0, 1.0]])
    nis = np.array([3.0, -2.0]) @ np.linalg.solve(H @ np.diag([4.0, 1.0]) @ H.T + np.diag([0.25, 0.5]), [3.0, -2.0])
    np.testing.assert_allclose(fold._now.state[-1], 1.0 + (nis / 2 - 1.0) / 50, rtol=1e-12)


RUNS, STEPS, MEMORY = 20, 2500, 200


def steady_S(q, r):
    """S of a random walk that is read every second: P = q/2 + √(q²/4 + q r), by Riccati's equation; S = P + r."""
    return 0.5 * q + np.sqrt(0.25 * q * q + q * r) + r


def simulated(seed, q, r):
    rng = np.random.default_rng(seed)
    return np.cumsum(np.sqrt(q) * rng.standard_normal(STEPS)) + np.sqrt(r) * rng.standard_normal(STEPS)


def test_adaptation_recovers_a_wrong_r(estimator):
    """Tuned to 1, truly 4: the fading mean of N samples of variance 2 S² has variance 2 S² / (2 N - 1).

    An r that is off moves P and so the gain, which feeds back on the samples: less than half of S is P here.
    """
    q, r = 0.04, 4.0
    S = steady_S(q, r)
    spread = S * np.sqrt(2.0 / (2 * MEMORY - 1))
    runs = RUNS if estimator == "kf" else 3
    found = []
    for seed in range(runs):
        options = {"adapt": 1, "memory": MEMORY}
        fold = folded(estimator, model(q=q, r=1.0), simulated(seed, q, r), options)
        found.append(fold._now.state[-1])
        # What is in use is what the track shows: S = P + r.
        np.testing.assert_allclose(fold.track.innovation_std[-1, 0] ** 2, S, atol=5 * spread)
    assert abs(np.mean(found) - r) < 4 * spread / np.sqrt(runs)
    if runs > 10:
        assert 0.5 * spread < np.std(found) < 2.0 * spread


def test_adaptation_recovers_a_wrong_q(estimator):
    """Tuned to 0.1, truly 1: ln s settles about ln 10 with variance 1 / (N m γ), γ = d ln S / d ln s."""
    q, r = 1.0, 1.0
    gamma = (np.log(steady_S(1.01 * q, r)) - np.log(steady_S(0.99 * q, r))) / np.log(1.01 / 0.99)
    spread = 1.0 / np.sqrt(MEMORY * gamma)
    runs = RUNS if estimator == "kf" else 3
    options = {"adapt": 2, "memory": MEMORY, "bound": 100.0}
    found = [
        np.log(folded(estimator, model(q=0.1 * q, r=r), simulated(seed, q, r), options)._now.state[-1])
        for seed in range(runs)
    ]
    assert abs(np.mean(found) - np.log(10.0)) < 4 * spread / np.sqrt(runs)
    if runs > 10:
        assert 0.5 * spread < np.std(found) < 2.0 * spread


@pytest.mark.parametrize(
    ("adapted", "tuned", "expected", "tolerance"),
    [(1, 0.01, 0.1, 1e-14), (1, 1000.0, 100.0, 1e-14), (2, 1e-4, 10.0, 1e-14), (2, 1e3, 0.1, 0.2)],
)
def test_what_is_adapted_stays_within_its_bound(estimator, adapted, tuned, expected, tolerance):
    true = {"q": 0.04, "r": 4.0} if adapted == 1 else {"q": 1.0, "r": 1.0}
    own = model(**true | {" rq"[adapted]: tuned})
    fold = folded(estimator, own, simulated(0, *true.values()), {"adapt": adapted, "memory": 50})
    np.testing.assert_allclose(fold._now.state[-1], expected, rtol=tolerance)


def test_only_readings_that_were_used_adapt(estimator):
    """Held out, missing and gated readings leave what is remembered alone."""
    options = {"adapt": 1, "memory": 20}
    values = [0.1, np.nan, 0.2, 500.0, 0.3]
    fold = folded(estimator, model(q=0.01), values, options, gate=0.99)
    assert list(fold.track.verdict[[0, 3]]) == [USED, GATED]
    fold_without = folded(estimator, model(q=0.01), [0.1, np.nan, 0.2, np.nan, 0.3], options, gate=0.99)
    np.testing.assert_array_equal(fold._now.state, fold_without._now.state)
    tuning = Tuning.of(model()).with_options(options).set("use.y", False)
    held_out = Fold(estimator, model(), tuning, readings_of([0.5, 9.0]))
    held_out.advance()
    np.testing.assert_array_equal(held_out._now.state[-2:], [R, R])


def test_each_row_has_its_own_variance():
    """Of three sensors with six rows only the third's second row is noisier than tuned; it alone moves far."""
    matrices = random_linear(np.random.default_rng(1), 2, 0)
    rng = np.random.default_rng(4)
    x, t, batch = matrices.mean.copy(), 0, []
    for k in range(6000):
        t += SECOND // 10
        x = x + 0.1 * matrices.A @ x + rng.multivariate_normal(np.zeros(2), matrices.q * 0.1 * matrices.W)
        sensor = k % 3
        noise = np.sqrt(matrices.R[sensor] * (np.array([1.0, 9.0, 1.0]) if sensor == 2 else 1.0))
        y = matrices.H[sensor] @ x + noise * rng.standard_normal(ROWS[sensor])
        batch.append(Events.one(t, t, READING, sensor, y, 3))
    log = as_log(Events.concat(batch, 3))
    tuning = Tuning.of(matrices.model).with_options({"adapt": 1, "memory": 500, "bound": 30})
    fold = Fold("ekf", matrices.model, tuning, log)
    fold.advance()
    ratio = fold._now.state[-6:] / np.concatenate(matrices.R)
    expected = np.array([1.0, 1.0, 1.0, 1.0, 9.0, 1.0])
    S = fold.track.innovation_std
    for row, (sensor, column) in enumerate([(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]):
        last = 6000 - 3 + sensor
        spread = S[last, column] ** 2 * np.sqrt(2.0 / 999) / matrices.R[sensor][column]
        assert abs(ratio[row] - expected[row]) < 5 * spread


def test_a_reset_forgets(estimator):
    options = {"adapt": 1, "memory": 10}
    fold = folded(estimator, model(q=0.01), [0.0, 3.0, -4.0], options)
    assert fold._now.state[-1] != R
    from estimators.log import RESET

    log = readings_of([0.0, 3.0, -4.0])
    log.extend(Events.one(5 * SECOND, 0, RESET, 0, [], 1))
    fold = Fold(estimator, model(q=0.01), Tuning.of(model(q=0.01)).with_options(options), log)
    fold.advance()
    np.testing.assert_array_equal(fold._now.state[-2:], [R, R])


@pytest.mark.parametrize("y", [(9.0, -6.0), (np.nan, 40.0)])
@pytest.mark.parametrize("robust", [0, 1, 2])
@pytest.mark.parametrize("name", ["kf", "ekf", "iekf"])
def test_joseph_and_the_short_form_agree(name, robust, y):
    on, off = (folded(name, PLANE, [y], {"robust": robust, "joseph": choice}).moments() for choice in (1, 0))
    for a, b in zip(on, off, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    assert not np.array_equal(on[1], off[1])


CORRELATION = ((1.0, -0.7), (-0.7, 1.0))


def turned_rows(x, u, p, out):
    """The rows of `mixed`, turned so that their noise is independent: p holds the eigenvectors of R, by rows."""
    first = x[0] + 0.5 * x[1]
    second = x[1] - x[0]
    out[0] = p[0] * first + p[1] * second
    out[1] = p[2] * first + p[3] * second


def as_independent(model):
    """The same model with independent rows Vᵀ y, from R = V diag(values) Vᵀ; and Vᵀ."""
    std = np.sqrt([row.variance for row in model.sensors[0].rows])
    values, V = np.linalg.eigh(np.array(CORRELATION) * np.outer(std, std))
    rows = tuple(Row(f"z{i}", "m", variance=value) for i, value in enumerate(values))
    parameters = tuple(Parameter(f"p{i}", "1", value) for i, value in enumerate(V.T.ravel()))
    return replace(model, sensors=(Sensor("y", rows, h=turned_rows),), parameters=parameters), V.T


@pytest.mark.parametrize("options", [{}, {"robust": 1, "huber": 0.7}, {"robust": 2, "dof": 3.0}])
def test_weights_of_correlated_rows_are_those_of_independent_ones(estimator, options):
    """A weight scales R as a whole; turned to its axes the reading says the same, whatever outlier it holds."""
    related = replace(PLANE, sensors=(replace(PLANE.sensors[0], correlation=CORRELATION),))
    apart, turn = as_independent(related)
    values = [[0.5, -0.3], [9.0, -2.0], [0.2, 0.4], [-20.0, 30.0]]
    one = folded(estimator, related, values, options)
    other = folded(estimator, apart, [turn @ value for value in values], options)
    for a, b in zip(one.moments(), other.moments(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one.track.nis, other.track.nis, rtol=1e-9)
    np.testing.assert_allclose(one.track.log_likelihood, other.track.log_likelihood, rtol=1e-9)


def test_adapted_variances_keep_the_correlation(estimator):
    """One reading: each row's variance moves as if alone, r ← r + (ν² - S) / N; the next S has c √(r₁ r₂) beside it."""
    related = replace(PLANE, sensors=(replace(PLANE.sensors[0], correlation=CORRELATION),))
    y = np.array([[3.0, -4.0], [1.0, 2.0]])
    fold = folded(estimator, related, y, {"adapt": 1, "memory": 10.0, "bound": 100.0})
    H = np.array([[1.0, 0.5], [-1.0, 1.0]])
    P, r = np.diag([4.0, 1.0]), np.array([0.25, 0.5])
    x = np.zeros(2)
    for k in range(2):
        R = np.array(CORRELATION) * np.sqrt(np.outer(r, r))
        S, nu = H @ P @ H.T + R, y[k] - H @ x
        np.testing.assert_allclose(fold.track.nis[k], nu @ np.linalg.solve(S, nu), rtol=1e-11)
        np.testing.assert_allclose(fold.track.innovation_std[k], np.sqrt(np.diag(S)), rtol=1e-12)
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ nu, P - K @ S @ K.T
        r = r + 0.1 * (nu**2 - np.diag(S))
    np.testing.assert_allclose(fold.moments()[0], x, rtol=1e-10)
