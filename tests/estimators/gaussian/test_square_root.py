"""The square-root filters: the same estimates as the plain forms, and right where those must fail.

Tolerance between the forms, 1e-8 relative: 200 steps of a few hundred roundings, times the condition of P.
"""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from estimators.errors import EstimatorError
from estimators.log import READING
from estimators.model.state_space import Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.track import FAILED, USED
from estimators.tuning import Tuning
from tests.estimators.interpreted.test_filterpy import PENDULUM, log  # noqa: F401  the fixture
from tests.models import level_model, unchanged
from tests.support import folded as advanced
from tests.support import log_of

FILTERPY = ["filterpy-kf", "filterpy-ekf", "filterpy-ukf"]
EVERYTHING = [
    {},
    {"robust": 1, "huber": 0.8},
    {"robust": 2, "dof": 3.0},
    {"adapt": 1, "memory": 20},
    {"adapt": 2, "memory": 20},
    {"inflation": 2.0, "robust": 1, "adapt": 2, "memory": 30},
]


def folded(estimator, model, log, options=None, **tuned):  # noqa: F811
    tuning = Tuning.of(model).with_options(options or {})
    for key, value in tuned.items():
        tuning = tuning.set(key, value)
    return advanced(estimator, model, log, tuning, pairs=np.array([[0, 1], [2, 1]]))


def same(a, b, tolerance):
    for name in ("mean", "std", "cross", "innovation", "innovation_std", "nis", "log_likelihood"):
        left, right = getattr(a, name), getattr(b, name)
        scale = max(1e-3, float(np.nanmax(np.abs(right))))
        np.testing.assert_allclose(left, right, rtol=0, atol=tolerance * scale, err_msg=name)
    np.testing.assert_array_equal(a.verdict, b.verdict)


@pytest.mark.parametrize("options", EVERYTHING, ids=str)
@pytest.mark.parametrize(("root", "plain"), [("sr-ekf", "ekf"), ("sr-ukf", "ukf")])
def test_square_roots_say_what_the_plain_forms_say(log, root, plain, options):  # noqa: F811
    a, b = (folded(name, PENDULUM, log, options) for name in (root, plain))
    same(a.track, b.track, 1e-8)
    np.testing.assert_allclose(a.moments()[1], b.moments()[1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(a.points(), b.points(), rtol=0, atol=1e-8)


@pytest.mark.parametrize("gate", [0.9, 0.5])
@pytest.mark.parametrize(("root", "plain"), [("sr-ekf", "ekf"), ("sr-ukf", "ukf")])
def test_the_gate_refuses_the_same_readings(log, root, plain, gate):  # noqa: F811
    a, b = (folded(name, PENDULUM, log, gate=gate).track for name in (root, plain))
    assert 5 < np.sum(b.verdict == 2)
    same(a, b, 1e-8)


@pytest.mark.parametrize("values", [{"alpha": 0.9, "beta": 0.0, "kappa": -0.5}, {"alpha": 0.5, "beta": 2.0}])
def test_a_negative_central_weight_is_taken_off(log, values):  # noqa: F811
    """λ/(n+λ) + 1 - α² + β is -0.29 and -0.25 here, for n = 3."""
    total = values["alpha"] ** 2 * (3 + values.get("kappa", 0.0))
    assert 1 - 3 / total + 1 - values["alpha"] ** 2 + values["beta"] < -0.2
    same(folded("sr-ukf", PENDULUM, log, values).track, folded("ukf", PENDULUM, log, values).track, 1e-8)


@pytest.mark.parametrize("estimator", ["ukf", "ckf"])
def test_what_rounding_made_indefinite_is_repaired(estimator):
    """A reading of the variance 1e-14 leaves less of the prior's 900 than its subtraction rounds; P is R ever after."""
    model = level_model({"y": 1e-14}, 1e-4, std=30.0)
    track = advanced(estimator, model, log_of(1, *((k, READING, 0.1) for k in range(3)))).track
    np.testing.assert_array_equal(track.verdict, USED)
    np.testing.assert_allclose(track.mean, 0.1, rtol=0, atol=1e-7)
    np.testing.assert_allclose(track.std[1:], 1e-7, rtol=1e-5)
    assert 1e-7 < track.std[0] < 1e-6


def square(x, u, p, dt, out):
    out[0] = 0.5 * x[0] * x[0]


def squared(x, u, p, out):
    out[0] = 0.5 * x[0] * x[0]


def one(f, h, q):
    return level_model({"y": 1e-6}, q, state="a", f=f, h=h)


@pytest.mark.parametrize("estimator", ["ukf", "sr-ukf"])
def test_a_negative_weight_that_outweighs_the_others_fails_visibly(estimator):
    """y = x²/2 at x = 0 ± 1 with κ = -0.9, α = 1, β = 0: the points lie at ±√0.1 and 0, D = -d, with d = 0.05.

    The mean is 0.05·10 = 0.5, so D₀ = -0.5, D± = -0.45: S = -9·0.25 + 10·0.2025 = -0.225 < 0.
    """
    values = {"alpha": 1.0, "beta": 0.0, "kappa": -0.9}
    model = one(unchanged, squared, 1e-9)
    fold = advanced(estimator, model, log_of(1, (0, READING, 0.3)), options=values)
    assert fold.track.verdict[0] == FAILED
    np.testing.assert_array_equal(fold.track.mean[0], 0.0)
    model = one(square, squared, 1e-9)
    fold = advanced(estimator, model, log_of(1, (0, READING, np.nan), (1, READING, 0.3)), options=values)
    assert fold.track.verdict[1] == FAILED
    assert np.isnan(fold.track.std[1, 0])  # the health of such a row is `diverged`


def twins(x, u, p, out):
    out[0] = x[0] + x[1] + x[2]
    out[1] = x[0] + x[1] + (1.0 + 1e-9) * x[2]


def first_twin(x, u, p, out):
    out[0] = x[0] + x[1] + x[2]


def second_twin(x, u, p, out):
    out[0] = x[0] + x[1] + (1.0 + 1e-9) * x[2]


def rows(*names):
    return tuple(Row(name, "1", variance=1e-18) for name in names)


TWINS = StateSpaceModel(
    name="twins",
    title="two sensors that say nearly the same",
    states=tuple(State(name, "1") for name in "abc"),
    noises=(Noise("a", "1", variance=0.0),),
    sensors=(
        Sensor("both", rows("y1", "y2"), h=twins),
        Sensor("first", rows("y"), h=first_twin),
        Sensor("second", rows("y"), h=second_twin),
    ),
    f=unchanged,
    linear=True,
)
Y = np.array([0.3 - 0.5 + 0.7, 0.3 - 0.5 + 0.7 * (1.0 + 1e-9)])


def exact():
    """Mean and covariance given Y, in rational numbers: P = I, H and R as their floats are."""
    H = [[Fraction(1)] * 3, [Fraction(1), Fraction(1), Fraction(1.0 + 1e-9)]]
    r = Fraction(1e-18)
    S = [[sum(a * b for a, b in zip(H[i], H[j], strict=True)) + (r if i == j else 0) for j in range(2)] for i in (0, 1)]
    det = S[0][0] * S[1][1] - S[0][1] * S[1][0]
    inverse = [[S[1][1] / det, -S[0][1] / det], [-S[1][0] / det, S[0][0] / det]]
    K = [[sum(H[k][i] * inverse[k][j] for k in range(2)) for j in range(2)] for i in range(3)]
    mean = [sum(K[i][j] * Fraction(float(Y[j])) for j in range(2)) for i in range(3)]
    cov = [[(i == j) - sum(K[i][k] * H[k][j] for k in range(2)) for j in range(3)] for i in range(3)]
    return np.array(mean, float), np.array(cov, float)


AT_ONCE = [(0, READING, Y, 0)]
ONE_BY_ONE = [(0, READING, Y[:1], 1), (0, READING, Y[1:], 2)]


@pytest.mark.parametrize("readings", [AT_ONCE, ONE_BY_ONE])
@pytest.mark.parametrize("estimator", ["sr-kf", "sr-ekf", "sr-ukf"])
def test_a_reading_beyond_the_digits_of_the_plain_forms(estimator, readings):
    """S = H Hᵀ + R has a condition of 1e18; its factor one of 1e9, which leaves 1e-7 of a double."""
    fold = folded(estimator, TWINS, log_of(2, *readings))
    mean, cov = exact()
    assert np.all(fold.track.verdict == USED)
    np.testing.assert_allclose(fold.moments()[0], mean, rtol=0, atol=1e-6)
    np.testing.assert_allclose(fold.moments()[1], cov, rtol=0, atol=1e-6)
    np.testing.assert_allclose(fold.track.std[-1], np.sqrt(np.diag(cov)), rtol=0, atol=1e-6)


@pytest.mark.parametrize("options", [{"joseph": 0}, {"joseph": 1}, {}])
@pytest.mark.parametrize("estimator", ["kf", "ekf", "iekf", "ukf", "ckf", *FILTERPY])
def test_the_plain_forms_refuse_it_and_say_so(estimator, options):
    try:
        fold = folded(estimator, TWINS, log_of(2, *AT_ONCE), options)
    except EstimatorError:
        assert "joseph" in options and estimator in ("ukf", "ckf", *FILTERPY)
        return
    assert fold.track.verdict[0] == FAILED
    np.testing.assert_array_equal(fold.moments()[0], np.zeros(3))
    np.testing.assert_array_equal(fold.moments()[1], np.eye(3))


def near_twins(x, u, p, out):
    out[0] = x[0] + x[1] + x[2]
    out[1] = x[0] + x[1] + (1.0 + p[0]) * x[2]


NEAR_TWINS = replace(
    TWINS,
    name="near_twins",
    parameters=(Parameter("apart", "1", 0.0),),
    sensors=(Sensor("both", rows("y1", "y2"), h=near_twins),),
)


@pytest.mark.parametrize("estimator", ["kf", "ekf", "iekf", "ukf", "ckf"])
@pytest.mark.parametrize(("apart", "verdict"), [(4e-8, FAILED), (1e-6, USED)])
def test_a_pivot_that_rounding_could_have_made_is_refused(estimator, apart, verdict):
    """The second pivot of H Hᵀ is 2/3 δ²: 1e-15, which rounding of 3 makes too, and so has a root; or 7e-13."""
    model = replace(NEAR_TWINS, parameters=(Parameter("apart", "1", apart),))
    fold = folded(estimator, model, log_of(2, *AT_ONCE))
    assert fold.track.verdict[0] == verdict


@pytest.mark.parametrize("estimator", ["sr-kf", "sr-ekf", "sr-ukf"])
def test_square_roots_refuse_what_their_own_digits_cannot_tell(estimator):
    """The same row twice with noise of 1e-20: the second diagonal entry is rounding, 1e-16, beside 1.7."""
    twice = tuple(Row(name, "1", variance=1e-40) for name in ("y1", "y2"))
    model = replace(NEAR_TWINS, sensors=(Sensor("both", twice, h=near_twins),))
    fold = folded(estimator, model, log_of(2, *AT_ONCE))
    assert fold.track.verdict[0] == FAILED
    np.testing.assert_array_equal(fold.track.mean[0], 0.0)


@pytest.mark.parametrize("estimator", ["kf", "ekf", "iekf", "ukf", "ckf", *FILTERPY])
def test_one_by_one_the_plain_forms_refuse_the_second(estimator):
    """H₂ P H₂ᵀ is nothing but rounding after the first: what R is beside that, no gain can know."""
    fold = folded(estimator, TWINS, log_of(2, *ONE_BY_ONE))
    assert list(fold.track.verdict) == [USED, FAILED]
    np.testing.assert_array_equal(fold.track.mean[1], fold.track.mean[0])
