"""EM ends where the likelihood of the readings is at its maximum, and never lowers it on the way."""

import numpy as np
import pytest
from scipy.optimize import minimize

from estimators.errors import EstimatorError
from estimators.fold import fold
from estimators.log import READING, Events
from estimators.smoothing.em import em
from estimators.tuning import Tuning
from tests.estimators.smoothing.test_dense import BODY, moved
from tests.support import SECOND, as_log


def drive(n=400, seed=5):
    """Readings of the body at irregular times, some further apart than a step of the model may be."""
    rng = np.random.default_rng(seed)
    x, t, rows = np.array([1.0, -0.5]), 0.0, []
    for _ in range(n):
        dt = rng.choice([0.1, 0.3, 1.0])
        F, Q = moved(dt)
        x, t = F @ x + rng.multivariate_normal(np.zeros(2), Q), t + dt
        rows.append((round(t * SECOND), x[0] + rng.normal(0, 0.5)))
    return as_log(Events.alike(READING, np.array([t for t, _ in rows]), np.array([y for _, y in rows])))


def test_it_agrees_with_the_maximum():
    log, begin = drive(), Tuning.of(BODY).set("Q.push", 3.0).set("R.place", 0.05)

    def negative(logs):
        tuning = begin.set("Q.push", float(np.exp(logs[0]))).set("R.place", float(np.exp(logs[1])))
        return -float(fold("kf", BODY, tuning, log).log_likelihood.sum())

    best = minimize(negative, np.log([0.3, 0.25]), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-10})
    found = em("kf", BODY, begin, log, tolerance=1e-7)
    assert found.converged and found.change < 1e-7
    # The last round changed less than 1e-7, and those that would follow, with a rate of 0.97, thirty times that.
    np.testing.assert_allclose([found.tuning.q[0], found.tuning.r[0]], np.exp(best.x), rtol=1e-5)
    assert np.all(np.diff(found.log_likelihood) > -1e-9)
    assert abs(found.log_likelihood[-1] + best.fun) < 1e-6


@pytest.mark.parametrize("estimator", ["ekf", "ukf", "sr-ukf"])
def test_every_gaussian_filter_has_the_same_rounds(estimator):
    log, begin = drive(100), Tuning.of(BODY)
    with pytest.warns(RuntimeWarning, match="em: not converged after 3 pairs of rounds: a variance changes by 0"):
        one, other = (em(name, BODY, begin, log, rounds=3) for name in ("kf", estimator))
    assert not one.converged and one.change > 1e-5
    np.testing.assert_allclose([*one.tuning.q, *one.tuning.r], [*other.tuning.q, *other.tuning.r], rtol=1e-9)


def test_what_is_not_to_be_fitted_stays_and_what_cannot_be_is_refused():
    log, begin = drive(50), Tuning.of(BODY)
    with pytest.warns(RuntimeWarning, match="em: not converged after 2"):
        found = em("kf", BODY, begin, log, noises=(), rounds=2)
    assert found.tuning.q[0] == begin.q[0] and found.tuning.r[0] != begin.r[0]
    with pytest.raises(EstimatorError, match="em: enkf draws at random"):
        em("enkf", BODY, begin, log)
