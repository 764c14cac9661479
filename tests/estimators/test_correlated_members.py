"""Sensors of several rows: correlated ones against the dense Gaussian solution, and more of them than a byte counts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, f, multivariate_t

from estimators.diagnostics.score import log_density
from estimators.errors import EstimatorError
from estimators.fold import Fold, fold
from estimators.gate.isolation import degrees
from estimators.log import READING, Events, Log
from estimators.model.parts import covariance_of
from estimators.models.lorenz import LORENZ96
from estimators.registry import ESTIMATORS, checked
from estimators.track import GATED
from estimators.tuning import Tuning
from tests.estimators.linear_models import assert_mean, kalman, random_linear
from tests.models import level_model
from tests.support import log_of

C = ((1.0, 0.8, -0.5), (0.8, 1.0, -0.2), (-0.5, -0.2, 1.0))
MATRICES = random_linear(np.random.default_rng(3), 4, 1)
MODEL = replace(
    MATRICES.model,
    sensors=(*MATRICES.model.sensors[:2], replace(MATRICES.model.sensors[2], correlation=C)),
    conditionally_linear=MATRICES.model.state_names,
)
Y = np.array([1.3, -0.4, 2.2])
H, OFFSET, R = MATRICES.H[2], MATRICES.D[2] @ MATRICES.u, covariance_of(C, MATRICES.R[2])
DENSITIES = [name for name, entry in ESTIMATORS.items() if entry.family != "reference" and not entry.applies(MODEL)]
THERE = [[0, 1, 2], [0, 2], [1, 2], [2]]


def rows_there(there):
    """A log of one reading, of which these rows came."""
    y = np.full(3, np.nan)
    y[there] = Y[there]
    return log_of(MODEL.width, (0, READING, y, 2))


def update(mean, P, there):
    """Mean, covariance, NIS, log-likelihood and √diag S of N(mean, P) given the rows that are there."""
    return kalman(mean, P, H[there], OFFSET[there], R[np.ix_(there, there)], Y[there])


@pytest.mark.parametrize("there", THERE)
@pytest.mark.parametrize("members", [2, 3, 40])
@pytest.mark.parametrize("name", ["enkf", "etkf", "ensrf", "letkf"])
def test_ensembles_take_the_whole_r(name, members, there):
    """Kalman's update of the sample moments: an identity, but for the covariance of enkf, which is right on average."""
    run = Fold(name, MODEL, Tuning.of(MODEL).with_options({"members": members}), rows_there(there))
    before = run.points()
    run.advance()
    after = run.points()
    mean, P, nis, log_likelihood, std = update(before.mean(0), np.cov(before.T), there)
    np.testing.assert_allclose(after.mean(0), mean, rtol=0, atol=1e-10)
    if name != "enkf":
        np.testing.assert_allclose(np.cov(after.T), P, rtol=0, atol=1e-10)
    assert run.track.nis[0] == pytest.approx(nis, rel=1e-9)
    assert run.track.log_likelihood[0] == pytest.approx(log_likelihood, rel=1e-9)
    np.testing.assert_allclose(run.track.innovation_std[0, there], std, rtol=1e-9)
    assert run.track.dof[0] == len(there) == np.isfinite(run.track.innovation[0]).sum()


@pytest.mark.parametrize("name", DENSITIES)
@pytest.mark.parametrize(("there", "factor"), [([0, 1, 2], 30.0), ([0, 2], 30.0), ([2], 30.0), ([0, 1, 2], 1e7)])
def test_the_density_of_a_rejected_measurement_has_the_whole_s(name, there, factor):
    """A multivariate Cauchy density of scale S in the tail beyond the gate, whatever the filter.

    S of a filter that draws is a sample covariance of N = 4000: ½ log |S| has a deviation of ½ √(2 m / N), and the term
    of the NIS one of ½ (m + 1) √(2 / N); four of both. Beyond a NIS of 1e12, the rows count as independent.
    """
    drawn = {"ensemble": {"members": 4000}, "particle": {"particles": 4000}}.get(ESTIMATORS[name].family, {})
    tuning = Tuning.of(MODEL).set("gate", 0.99).with_options(drawn)
    log = rows_there(there)
    log.events.value[0, there] *= factor
    track = fold(name, MODEL, tuning, log)
    assert track.verdict[0] == GATED
    S = H[there] @ np.diag(MATRICES.std**2) @ H[there].T + R[np.ix_(there, there)]
    nu = factor * Y[there] - H[there] @ MATRICES.mean - OFFSET[there]
    outside = f.sf(chi2.ppf(0.99, len(there)) / len(there), len(there), 1)
    expected = multivariate_t(df=1, shape=S).logpdf(nu) + np.log(0.01 / outside)
    if factor > 1e6:
        expected -= 0.5 * np.log(np.prod(np.diag(S)) / np.linalg.det(S))
    assert log_density(track, 0.99)[0] == pytest.approx(expected, abs=0.2 if drawn else 1e-6)


def test_perturbations_are_correlated():
    """The spread of enkf is Kalman's on average over the draws of v ~ N(0, R).

    For Gaussian perturbations a sample covariance from N = 2000 members is off by P √(2 / N), 3 %; five of these.
    """
    run = Fold("enkf", MODEL, Tuning.of(MODEL).with_options({"members": 2000}), rows_there([0, 1, 2]))
    before = run.points()
    run.advance()
    _, P, *_ = update(before.mean(0), np.cov(before.T), [0, 1, 2])
    scale = np.sqrt(np.diag(P))
    off = (np.cov(run.points().T) - P) / np.outer(scale, scale)
    assert np.max(np.abs(off)) < 5 * np.sqrt(2 / 2000)


@pytest.mark.parametrize("there", THERE)
@pytest.mark.parametrize("name", ["pf", "pf-ekf", "apf"])
def test_particles_are_weighed_by_the_whole_r(name, there):
    """The mean of 40 clouds is right to its standard error, but for a bias of 1/N of the posterior's spread.

    The likelihood is unbiased, so its mean over the clouds is right to its standard error too.
    """
    tuning = Tuning.of(MODEL).with_options({"particles": 4000})
    runs = [fold(name, MODEL, replace(tuning, seed=seed), rows_there(there)) for seed in range(40)]
    mean, P, nis, log_likelihood, std = update(MATRICES.mean, np.diag(MATRICES.std**2), there)
    assert_mean([run.mean[0] for run in runs], mean, 20 / 4000 * np.sqrt(np.diag(P)))
    ratio = [np.exp(run.log_likelihood[0] - log_likelihood) for run in runs]
    assert np.std(ratio) < 0.5
    assert_mean(ratio, 1.0)
    # S is a sample covariance of 40 × 4000 draws.
    assert abs(np.mean([run.nis[0] for run in runs]) / nis - 1) < 0.05
    stds = np.mean([run.innovation_std[0, there] for run in runs], axis=0)
    np.testing.assert_allclose(stds, std, rtol=5 / np.sqrt(2 * 40 * 4000))


def test_correlated_rows_cannot_be_localised():
    sensor = LORENZ96.sensors[0]
    n = len(sensor.rows)
    correlation = np.eye(n) + 0.3 * (np.eye(n, k=1) + np.eye(n, k=-1))
    model = replace(LORENZ96, sensors=(replace(sensor, correlation=correlation), *LORENZ96.sensors[1:]))
    for name in ("enkf", "ensrf", "letkf"):
        assert checked(ESTIMATORS[name], model, {"radius": 0.0})
        with pytest.raises(EstimatorError, match="radius is 4, but the rows of lorenz96's sensor .* set radius to 0"):
            checked(ESTIMATORS[name], model, {"radius": 4.0})
        with pytest.raises(EstimatorError, match="are correlated: made independent, none of them has a place"):
            Fold(name, model, Tuning.of(model).with_options({"radius": 4.0}), Log(model.width))


ROWS = 200
READINGS = 30


GAUGES = level_model({"gauges": {f"g{k}": 0.25 for k in range(ROWS)}}, 1e-4, state="x", linear=True)


@pytest.mark.parametrize("missing", [0, 60, 150])
def test_a_sensor_of_200_rows_has_200_degrees_of_freedom(missing):
    """NIS over the readings is χ² with as many degrees as there were rows: its bounds, and the figure itself."""
    y = np.random.default_rng(2).normal(0.0, 0.5, (READINGS, ROWS))
    y[:, :missing] = np.nan
    log = Log.of(GAUGES)
    t = np.arange(READINGS) * 10**9
    log.extend(Events.alike(READING, t, y))
    track = fold("kf", GAUGES, Tuning.of(GAUGES), log)
    m = ROWS - missing
    assert track.dof.tolist() == [m] * READINGS == degrees(track).tolist()
    low, high = chi2.ppf([0.025, 0.975], m * READINGS) / READINGS
    np.testing.assert_allclose([track.nis_low[-1], track.nis_high[-1]], [low, high], rtol=1e-9)
    # Four deviations of the mean of χ²: the prior is wider than the truth by a level that all rows share.
    assert abs(track.nis_mean[-1] - m) < 4.0 * np.sqrt(2.0 * m / READINGS) + 1.0
