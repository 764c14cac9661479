"""A prior given as a mean and a covariance: correlated, singular, certain; in every filter."""

import json

import numpy as np
import pytest

from estimators.errors import EstimatorError
from estimators.fold import Fold, fold
from estimators.log import READING, RESET, Events, Log
from estimators.models import MODELS
from estimators.registry import ESTIMATORS, unfit
from estimators.tuning import Tuning
from tests.cases import cases
from tests.estimators.linear_models import random_linear
from tests.support import SECOND, log_of

MATRICES = random_linear(np.random.default_rng(6), 3, 2)
MODEL = MATRICES.model
MEAN = np.array([1.0, -2.0, 0.5])
ROOT = np.array([[1.0, 0.0, 0.0], [-0.9, 0.3, 0.0], [0.4, 0.2, 0.5]])
PRIORS = {
    "correlated": ROOT @ ROOT.T,
    "of rank two": ROOT[:, :2] @ ROOT[:, :2].T,
    "of rank one": np.outer(ROOT[:, 0], ROOT[:, 0]),
    "one state certain": np.diag([1.0, 0.0, 4.0]),
    "all certain": np.zeros((3, 3)),
}
EXACT = [name for name, entry in ESTIMATORS.items() if entry.family == "Gaussian" and unfit(entry, MODEL) is None]
EXACT += ["filterpy-kf", "filterpy-ekf", "filterpy-ukf"]
FACTORED = ("ukf", "ckf", "filterpy-ukf")
DRAWN = ["pf", "pf-reg", "apf", "enkf", "etkf", "ensrf", "letkf", "filterpy-enkf"]
SIZE = 3000
SIZES = {"particles": float(SIZE), "members": float(SIZE)}


def posterior(P, y, sensor):
    """One reading by Bayes' rule in the form of Kalman's gain, written out."""
    H, R = MATRICES.H[sensor], np.diag(MATRICES.R[sensor])
    S = H @ P @ H.T + R
    nu = y - H @ MEAN - MATRICES.D[sensor] @ MATRICES.u
    K = P @ H.T @ np.linalg.inv(S)
    return MEAN + K @ nu, P - K @ S @ K.T, nu @ np.linalg.solve(S, nu)


def one_reading(y, sensor):
    return log_of(MODEL.width, (1, READING, y, sensor))


@pytest.mark.parametrize("kind", PRIORS)
@pytest.mark.parametrize("name", EXACT)
def test_gaussian_filters_start_there_exactly(name, kind):
    P = PRIORS[kind]
    y = np.array([0.7, -0.4])
    log = one_reading(y, 1)
    if name in FACTORED and kind != "correlated":
        with pytest.raises(EstimatorError, match=f"singular and has no sigma points for {name}; use sr-ukf or ekf"):
            Fold(name, MODEL, Tuning.of(MODEL), log, prior=(MEAN, P))
        return
    growing = Fold(name, MODEL, Tuning.of(MODEL), log, prior=(MEAN, P))
    mean, cov = growing.moments()
    np.testing.assert_allclose(mean, MEAN, rtol=1e-14)
    np.testing.assert_allclose(cov, P, rtol=1e-12, atol=1e-15)
    growing.advance()
    x, after, nis = posterior(P, y, 1)
    got = growing.moments()
    np.testing.assert_allclose(got[0], x, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(got[1], after, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(growing.track.nis[0], nis, rtol=1e-10)


@pytest.mark.parametrize("kind", PRIORS)
@pytest.mark.parametrize("name", DRAWN)
def test_particles_and_members_are_drawn_from_it(name, kind):
    """Sample moments within five of their standard errors; no spread at all where there is no variance."""
    P = PRIORS[kind]
    known = {option.name for option in ESTIMATORS[name].options}
    tuning = Tuning.of(MODEL).with_options({k: v for k, v in SIZES.items() if k in known})
    mean, cov = Fold(name, MODEL, tuning, Log.of(MODEL), prior=(MEAN, P)).moments()
    var = np.diag(P)
    assert np.all(np.abs(mean - MEAN) <= 5.0 * np.sqrt(var / SIZE) + 1e-12)
    # Var of a sample covariance of normals: (P_ii P_jj + P_ij²) / N.
    spread = np.sqrt((np.outer(var, var) + P**2) / SIZE)
    assert np.all(np.abs(cov - P) <= 5.0 * spread + 1e-12)


def test_a_state_that_is_certain_stays_so_until_noise_comes():
    """Zero variance, no noise in no time: a reading moves the others only."""
    P = PRIORS["one state certain"]
    for name in ("kf", "iekf", "sr-ukf", "enkf"):
        track = fold(name, MODEL, Tuning.of(MODEL), one_reading([5.0, 5.0], 1), prior=(MEAN, P))
        assert abs(track.mean[0, 1] - MEAN[1]) < 1e-9 and track.std[0, 1] < 1e-9, name
        assert abs(track.mean[0, 0] - MEAN[0]) > 1e-3, name


@pytest.mark.parametrize("name", ["kf", "pf", "filterpy-kf"])
def test_a_reset_goes_back_to_it(name):
    P = PRIORS["correlated"]
    log = one_reading([5.0, 5.0], 1)
    log.extend(Events.one(2 * SECOND, 0, RESET, 0, (), MODEL.width))
    growing = Fold(name, MODEL, Tuning.of(MODEL), log, prior=(MEAN, P))
    before = growing.moments()
    growing.advance()
    for a, b in zip(growing.moments(), before, strict=True):
        np.testing.assert_array_equal(a, b)


@cases(__file__, "no_priors.csv")
def test_what_is_no_prior_is_refused(prior, text):
    given = json.loads(prior)
    prior = tuple(map(np.array, given)) if isinstance(given[0], list) else np.array(given)
    with pytest.raises(EstimatorError, match=text):
        Fold("kf", MODEL, Tuning.of(MODEL), Log.of(MODEL), prior=prior)


def test_units_do_not_matter_for_what_is_semidefinite():
    """A correlation of 0.999 between a pressure in Pa and a length in m is a covariance, whatever the scales."""
    std = np.array([1e6, 1e-6, 1.0])
    C = np.array([[1.0, 0.999, 0.0], [0.999, 1.0, 0.0], [0.0, 0.0, 1.0]])
    growing = Fold("kf", MODEL, Tuning.of(MODEL), Log.of(MODEL), prior=(MEAN, C * np.outer(std, std)))
    np.testing.assert_allclose(growing.moments()[1], C * np.outer(std, std), rtol=1e-14)
    C[0, 1] = C[1, 0] = 1.001
    with pytest.raises(EstimatorError, match="positive semidefinite"):
        Fold("kf", MODEL, Tuning.of(MODEL), Log.of(MODEL), prior=(MEAN, C * np.outer(std, std)))


def test_a_large_field_takes_variances():
    model = MODELS["thermal_field"]
    variances = np.full((1, model.nx), 4.0)
    tuning = Tuning.of(model).with_options({"members": 20.0})
    growing = Fold("etkf", model, tuning, Log.of(model), prior=(np.full(model.nx, 7.0), variances))
    mean, cov = growing.moments()
    np.testing.assert_allclose(mean, 7.0, rtol=1e-12)
    # Of 20 members a variance is good to √(2/19) of itself; their mean over 40,000 cells is far better.
    assert 3.0 < cov.mean() < 5.0
    with pytest.raises(EstimatorError, match="cov has shape"):
        Fold("etkf", model, tuning, Log.of(model), prior=(mean, np.eye(3)))
