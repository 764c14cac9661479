"""On linear models every Gaussian filter equals a dense joint Gaussian over all states, conditioned in one solve.

The oracle (linear_models.py) is no recursion: an error that every recursive filter shares would show.

Tolerance 1e-9, relative to the size of the quantity: some hundred roundings of 1e-16, times the condition of the
oracle's own dense solve, which is 1e3 to 1e5 for these models.
"""

import numpy as np
import pytest

from estimators.log import READING, Events
from estimators.registry import ESTIMATORS
from estimators.track import HELD_OUT, MISSING, USED
from estimators.tuning import Tuning
from tests.estimators.linear_models import CORRELATED, case, close
from tests.support import folded

GAUSSIAN = [name for name, entry in ESTIMATORS.items() if entry.family == "Gaussian" and name != "kf-steady"]
CASES = [(nx, nu, 0) for nx, nu in ((1, 0), (1, 1), (2, 0), (3, 2), (4, 0), (5, 1))]
CASES += [(nx, nu, CORRELATED) for nx, nu in ((1, 0), (3, 2), (5, 1))]


@pytest.mark.parametrize("estimator", GAUSSIAN)
@pytest.mark.parametrize(("nx", "nu", "seed"), CASES)
def test_filtered_moments(estimator, nx, nu, seed):
    matrices, log, joint = case(nx, nu, seed)
    used = np.ones(3, bool)
    for k in (0, 1, 7, 23, log.n - 1):
        mean, cov = folded(estimator, matrices.model, log, stop=k + 1).moments()
        expected_mean, expected_cov = joint.filtered(k, used)
        close(mean, expected_mean, f"mean at {k}")
        close(cov, expected_cov, f"covariance at {k}")


@pytest.mark.parametrize("estimator", GAUSSIAN)
@pytest.mark.parametrize(("nx", "nu", "seed"), CASES)
def test_innovations_nis_and_likelihood(estimator, nx, nu, seed):
    matrices, log, joint = case(nx, nu, seed)
    used = np.ones(3, bool)
    track = folded(estimator, matrices.model, log).track
    events = log.events
    readings = np.flatnonzero(events.kind == READING)
    assert np.all((track.verdict == MISSING)[events.kind == READING] == ~np.isin(readings, joint.owner))
    for k in joint.events[::3]:
        assert track.verdict[k] == USED
        finite = np.isfinite(events.value[k, : matrices.model.ny])
        nu_k, S = joint.predictive(k, used)
        close(track.innovation[k, finite], nu_k, f"innovation at {k}")
        close(track.innovation_std[k, finite], np.sqrt(np.diag(S)), f"its deviation at {k}")
        assert np.all(np.isnan(track.innovation[k, ~finite]))
        close(track.nis[k], nu_k @ np.linalg.solve(S, nu_k), f"NIS at {k}")
        assert track.dof[k] == nu_k.size
    close(track.log_likelihood[track.verdict == USED].sum(), joint.log_likelihood(used), "log-likelihood")


@pytest.mark.parametrize("estimator", GAUSSIAN)
@pytest.mark.parametrize("held_out", ["first", "third"])
def test_held_out_sensor_is_predicted_and_scored_but_not_used(estimator, held_out):
    matrices, log, joint = case(4, 1, 5)
    tuning = Tuning.of(matrices.model).set(f"use.{held_out}", False)
    fold = folded(estimator, matrices.model, log, tuning)
    events, track = log.events, fold.track
    expected_mean, expected_cov = joint.filtered(log.n - 1, tuning.used)
    close(fold.moments()[0], expected_mean, "mean")
    close(fold.moments()[1], expected_cov, "covariance")
    seen = 0
    for k in joint.events:
        nu_k, S = joint.predictive(k, tuning.used)
        close(track.nis[k], nu_k @ np.linalg.solve(S, nu_k), f"NIS at {k}")
        log_likelihood = -0.5 * (track.nis[k] + np.linalg.slogdet(S)[1] + nu_k.size * np.log(2 * np.pi))
        close(track.log_likelihood[k], log_likelihood, f"log-likelihood at {k}")
        out = not tuning.used[events.channel[k]]
        assert track.verdict[k] == (HELD_OUT if out else USED)
        seen += out
    assert seen > 3
    close(track.log_likelihood[track.verdict == USED].sum(), joint.log_likelihood(tuning.used), "log-likelihood")


@pytest.mark.parametrize("estimator", GAUSSIAN)
def test_order_of_equal_times_does_not_matter(estimator):
    """Sequential updates at one time commute for a linear model: one joint update, whatever the order."""
    matrices, log, _ = case(3, 0, 9)
    events = log.events
    _, *columns = events.select(np.flatnonzero(events.kind == READING)[:8])
    together = Events(np.full(8, 10**9), *columns)
    moments = []
    for order in (np.arange(8), np.arange(8)[::-1], np.array([3, 1, 4, 0, 5, 2, 7, 6])):
        again = type(log)(log.width)
        again.extend(together.select(order))
        moments.append(folded(estimator, matrices.model, again).moments())
    for mean, cov in moments[1:]:
        close(mean, moments[0][0], "mean")
        close(cov, moments[0][1], "covariance")


@pytest.mark.parametrize(("alpha", "tolerance"), [(0.5, 1e-11), (1e-2, 1e-9), (1e-3, 1e-7)])
def test_ukf_is_exact_whatever_its_spread(alpha, tolerance):
    """Sigma points of a linear function give its moments exactly; rounding alone grows as 1/(α² n) ε cond."""
    matrices, log, joint = case(3, 1, 1)
    tuning = Tuning.of(matrices.model).with_options({"alpha": alpha})
    mean, cov = folded("ukf", matrices.model, log, tuning).moments()
    expected_mean, expected_cov = joint.filtered(log.n - 1, np.ones(3, bool))
    np.testing.assert_allclose(mean, expected_mean, rtol=0, atol=tolerance * np.max(np.abs(expected_mean)))
    np.testing.assert_allclose(cov, expected_cov, rtol=0, atol=tolerance * np.max(np.abs(expected_cov)))
