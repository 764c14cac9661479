"""States that are certain at first, and rows of a sensor that read without noise: where the algebra allows them."""

import numpy as np
import pytest

from estimators.errors import ConfigError, EstimatorError
from estimators.fold import Fold
from estimators.log import READING, Events
from estimators.registry import ESTIMATORS, find_estimator
from estimators.track import FAILED, USED
from estimators.tuning import Tuning
from tests.estimators.linear_models import JointGaussian, random_linear, random_log
from tests.models import level_model
from tests.support import as_log, folded, log_of

SINGULAR = [name for name, entry in ESTIMATORS.items() if entry.singular]


def apart(log):
    """The same events, each 10 ms after the one before at least: two exact readings at one time have no S."""
    events = log.events
    t, *columns = events.select(slice(0, None))
    return as_log(Events(t + 10**7 * np.arange(len(events)), *columns))


@pytest.mark.parametrize("estimator", SINGULAR)
@pytest.mark.parametrize(("nx", "seed", "correlated"), [(2, 0, False), (4, 1, False), (3, 2, True)])
def test_what_is_certain_equals_the_joint_gaussian(estimator, nx, seed, correlated):
    rng = np.random.default_rng([nx, seed])
    matrices = random_linear(rng, nx, 1, correlated=correlated, certain=True)
    log = apart(random_log(rng, matrices, events=40))
    joint = JointGaussian(matrices, log)
    used = np.ones(3, bool)
    fold = Fold(estimator, matrices.model, Tuning.of(matrices.model), log)
    for k in (0, 1, 7, 23, log.n - 1):
        fold.advance(k + 1 - fold.n)
        for actual, expected in zip(fold.moments(), joint.filtered(k, used), strict=True):
            # As in test_joint_gaussian.py; an exact row leaves variances of q dt, a hundredth of the others.
            scale = max(1e-3, float(np.max(np.abs(expected))))
            np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9 * scale)
    readings = log.events.kind == READING
    assert np.all(fold.track.verdict[joint.events] == USED) and readings.sum() > 20
    likelihood = fold.track.log_likelihood[fold.track.verdict == USED].sum()
    assert likelihood == pytest.approx(joint.log_likelihood(used), rel=1e-9)


def model(*, std=1.0, variance=0.0):
    return level_model({"y": variance}, 0.5, name="exact", state="x", std=std, linear=True)


@pytest.mark.parametrize("estimator", SINGULAR)
def test_an_exact_reading_is_believed_and_a_second_one_at_that_time_fails(estimator):
    fold = folded(estimator, model(), log_of(1, (0, READING, 2.0), (0, READING, 3.0), (2, READING, 4.0)))
    np.testing.assert_array_equal(fold.track.verdict, [USED, FAILED, USED])
    np.testing.assert_allclose(fold.track.mean[:, 0], [2.0, 2.0, 4.0], rtol=1e-14)
    np.testing.assert_allclose(fold.track.std[:, 0], 0.0, atol=1e-15)
    # Between them Q alone: S = 2 s · 0.5 m²/s.
    np.testing.assert_allclose(fold.track.nis[2], 2.0**2 / 1.0, rtol=1e-14)


@pytest.mark.parametrize("estimator", sorted(set(ESTIMATORS) - set(SINGULAR) - {"rbpf"}))
def test_the_others_say_why_not(estimator):
    with pytest.raises(EstimatorError, match=r"in exact y\.y reads without noise, and .* takes no singular covariance"):
        find_estimator(estimator, model())
    with pytest.raises(EstimatorError, match="in exact x is certain at first, and .* use kf, ekf"):
        find_estimator(estimator, model(std=0.0, variance=1.0))
    assert find_estimator(estimator, model(variance=1.0))


def test_a_variance_is_tuned_to_zero_only_where_the_model_says_so():
    assert Tuning.of(model()).set("R.y", 1.0).set("R.y", 0.0).get("R.y") == 0.0
    with pytest.raises(
        ConfigError, match=r"R\.y is 0; a variance must be positive, or zero where the model declares zero noise"
    ):
        Tuning.of(model(variance=1.0)).set("R.y", 0.0)
    with pytest.raises(ConfigError, match=r"R\.y is -1; a variance must be positive"):
        Tuning.of(model()).set("R.y", -1.0)
