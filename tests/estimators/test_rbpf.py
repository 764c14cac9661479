"""The Rao-Blackwellised filter against the Kalman filter, against exact mixtures over all mode sequences, and against pf."""

from dataclasses import replace
from itertools import product

import numba
import numpy as np
import pytest
from linear_models import SECOND, random_linear, random_log
from scipy.stats import multivariate_normal

from estimators.errors import EstimatorError, ModelError
from estimators.fold import Fold, fold
from estimators.log import READING, TICK, Log, Readings
from estimators.model import Jump, Noise, Row, Sensor, State, StateSpaceModel
from estimators.particle import RECOVERIES
from estimators.track import FAILED, USED
from estimators.tuning import Tuning

# A jump-Markov linear system: a walk that drifts in mode 1, seen by a sensor that is biased there.
STAY = ((0.9, 0.1), (0.2, 0.8))
DRIFT, BIAS, Q, R, DAMP = 1.5, 0.7, 0.05, 0.3, (0.95, 0.8)


def switched(x, u, p, dt, out):
    out[0] = (0.95 - 0.15 * x[2]) * x[0] + dt * x[1] + dt * 1.5 * x[2]
    out[1] = x[1]
    out[2] = x[2]


def chances(x, u, p, dt, out):
    if x[2] < 0.5:
        out[0], out[1] = 0.9, 0.1
    else:
        out[0], out[1] = 0.2, 0.8


def biased(x, u, p, out):
    out[0] = x[0] + 0.7 * x[2]


def jump_model(**changes):
    parts = dict(
        name="switched", title="", states=(State("s", "m", 0.0, 1.0), State("v", "m/s", 0.5, 0.4), State("m", "", 0.3, 0.46)),
        noises=(Noise("s", "m²/s", 0.05), Noise("v", "m²/s³", 0.02)), f=switched,
        sensors=(Sensor("y", (Row("y", "m", 0.3),), h=biased),),
        jump=Jump("m", ("rest", "drift"), chances), conditionally_linear=("s", "v"),
    )  # fmt: skip
    return StateSpaceModel(**(parts | changes))


READINGS = (0.4, 1.6, 3.1, 4.4, 3.9, 4.2)


def log_of(*values, width=3, every=1.0):
    log = Log(width)
    log.extend(Readings.one(0, 0, TICK, 0, np.zeros(width), width))
    for k, value in enumerate(values):
        t = int((k + 1) * every * SECOND)
        log.extend(Readings.one(t, t, READING, 0, np.atleast_1d(value), width))
    return log


def exact_mixture():
    """Posterior after every reading and log-likelihood, by a Kalman filter for each of the 2⁷ mode sequences."""
    parts = []
    for first in (0, 1):
        parts.append(([first], np.log((0.7, 0.3)[first]), np.array([0.0, 0.5]), np.diag([1.0, 0.16])))
    answers, total = [], 0.0
    for y in READINGS:
        grown = []
        for (path, weight, mean, cov), mode in product(parts, (0, 1)):
            F = np.array([[DAMP[mode], 1.0], [0.0, 1.0]])
            m = F @ mean + np.array([DRIFT * mode, 0.0])
            P = F @ cov @ F.T + np.diag([Q, 0.02])
            H = np.array([1.0, 0.0])
            S = H @ P @ H + R
            nu = y - H @ m - BIAS * mode
            K = P @ H / S
            log_w = weight + np.log(STAY[path[-1]][mode]) - 0.5 * (nu * nu / S + np.log(2 * np.pi * S))
            grown.append(([*path, mode], log_w, m + K * nu, P - np.outer(K, K) * S))
        logs = np.array([part[1] for part in grown])
        norm = np.logaddexp.reduce(logs)
        total += norm
        parts = [(path, log_w - norm, m, P) for path, log_w, m, P in grown]
        w = np.exp(logs - norm)
        means = np.array([[*m, path[-1]] for path, _, m, _ in parts])
        mean = w @ means
        cov = np.einsum("k,ki,kj->ij", w, means - mean, means - mean)
        cov[:2, :2] += np.einsum("k,kij->ij", w, np.array([P for *_, P in parts]))
        answers.append((mean, cov))
    return answers, total


def runs(model, n, seeds, log, name="rbpf", **options):
    tuning = Tuning.of(model).with_options({"particles": n, **options})
    return [fold(name, model, replace(tuning, seed=seed), log) for seed in range(seeds)]


@pytest.mark.parametrize("nx", [1, 3])
def test_with_nothing_to_sample_it_is_the_kalman_filter(nx):
    rng = np.random.default_rng(nx)
    matrices = random_linear(rng, nx, 1)
    log = random_log(rng, matrices, 40)
    model = replace(matrices.model, conditionally_linear=matrices.model.state_names)
    exact = Fold("kf", model, Tuning.of(model), log)
    exact.advance()
    run = Fold("rbpf", model, Tuning.of(model).with_options({"particles": 7}), log)
    run.advance()
    for column in ("mean", "std", "innovation", "innovation_std", "nis", "log_likelihood"):
        a, b = getattr(exact.track, column), getattr(run.track, column)
        assert np.allclose(a, b, rtol=1e-9, atol=1e-9, equal_nan=True), column
    assert np.array_equal(exact.track.verdict, run.track.verdict)
    assert np.allclose(exact.moments()[1], run.moments()[1], rtol=1e-9, atol=1e-10)
