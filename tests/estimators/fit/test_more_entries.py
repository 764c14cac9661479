"""Entries beside Q, R and parameters: options, the prior, how long errors last; and a search without slopes."""

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

from estimators.errors import ConfigError
from estimators.fit.entries import entries_of
from estimators.fit.fit import fit
from estimators.fit.objective import maximise, search
from estimators.fit.recording import Recording
from estimators.model.coloured import ColouredError, coloured
from estimators.tuning import Tuning
from tests.estimators.fit.test_fit import DECADES, MODEL, log_of, objective_of, simulated

DECADE = np.log(10.0)


def recursion(ys, q, r, inflation, rate=0.1):
    """Log density of readings a second apart, by the recursion of one number that is P."""
    a, x, P, total = 1.0 - rate, 0.0, 4.0, 0.0
    for k, y in enumerate(ys):
        if k:
            x, P = a * x, inflation * a * a * P + q
        S = P + r
        total -= 0.5 * ((y - x) ** 2 / S + np.log(2.0 * np.pi * S))
        x, P = x + P / S * (y - x), P * r / S
    return total


def test_an_option_is_found_at_the_maximum_of_its_likelihood():
    """The walk moves more than Q says, and the inflation makes up for that."""
    ys = simulated(4, 400, q=1.0)
    tuning = Tuning.of(MODEL).set("Q.level", 0.05).set("R.float", 0.5)
    found = fit("kf", tuning, [Recording(log_of(ys))], wanted=("options.inflation",), blocks=0)
    (line,) = found.lines

    def loss(x):
        return -recursion(ys, 0.05, 0.5, np.exp(x)) + 0.5 * (x / DECADE) ** 2

    best = minimize_scalar(loss, bounds=(0.0, 5.0), method="bounded", options={"xatol": 1e-6})
    assert best.x > 0.5
    # The optimiser stops within 0.02 deviations of the maximum; a file has four digits.
    assert abs(np.log(line.after) - best.x) < 0.05 * line.deviation + 1e-3
    assert found.setting.tuning.options["inflation"] == line.after and found.setting.prior is None


def test_the_prior_is_found_from_many_starts():
    """Forty logs of two readings each: what they share is from where they start."""
    logs = [3.0 + simulated(seed, 2) for seed in range(40)]
    wanted = ("prior.level.mean", "prior.level.std")
    tuning = Tuning.of(MODEL).set("Q.level", 0.2).set("R.float", 0.5)
    found = fit("kf", tuning, [Recording(log_of(ys)) for ys in logs], wanted=wanted, blocks=0)
    mean, std = found.lines

    def loss(x):
        m, s = x[0], np.exp(x[1])
        a = 0.9
        # Two readings of one walk: their joint covariance, with no filter.
        P = np.array([[s**2, a * s**2], [a * s**2, a * a * s**2 + 0.2]]) + 0.5 * np.eye(2)
        e = np.array(logs) - m * np.array([1.0, a])
        density = -0.5 * np.einsum("ki,ij,kj->", e, np.linalg.inv(P), e) - 20.0 * np.log(np.linalg.det(P))
        return -density + 0.5 * (m / 2.0) ** 2 + 0.5 * ((x[1] - np.log(2.0)) / DECADE) ** 2

    best = minimize(loss, [2.0, 0.5], method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9}).x
    assert abs(mean.after - best[0]) < 0.05 * mean.deviation + 1e-3
    assert abs(np.log(std.after) - best[1]) < 0.05 * std.deviation + 1e-3
    assert found.setting.prior is not None
    assert found.setting.prior[0][0] == mean.after and found.setting.prior[1][0, 0] == pytest.approx(std.after**2)


def test_how_long_errors_last_is_a_group():
    lasting = coloured(MODEL, {"level": 20.0}, {"float": ColouredError((0.3,), 5.0)})
    log = log_of(simulated(5, 50))
    keys = [item.key for item in entries_of("kf", Tuning.of(lasting), [log], ["over"])[0]]
    assert keys == ["p.level_disturbance_time", "p.float_error_time"]
    # Of a model whose errors do not last there are none; they do not stand in the way of others.
    assert [item.key for item in entries_of("kf", Tuning.of(MODEL), [log], ["Q", "over"])[0]] == ["Q.level"]
    with pytest.raises(ConfigError, match="nothing of over can be fitted"):
        entries_of("kf", Tuning.of(MODEL), [log], ["over"])


def test_a_search_without_slopes_ends_where_one_with_them_does():
    objective = objective_of(log_of(simulated(1, 150)), "Q", "R.float")
    x, value = maximise(objective, objective.start)
    y, other = search(objective, objective.start)
    # COBYQA ends with a trust region of 0.02; half the curvature times its square is left.
    curvature = np.sum(objective.slopes(x)[1] ** 2, axis=1) + objective.precision
    assert abs(other - value) < 0.5 * np.sum(curvature) * 0.02**2 + 1e-3
    assert np.all(np.abs(y - x) < 0.1 / np.sqrt(curvature) + 0.02)


def test_a_filter_that_draws_is_fitted_without_slopes(monkeypatch):
    """Its members stand for the Kalman filter's moments: 400 of them to 1 / √200 of a variance."""
    ys = simulated(1, 150)
    tuning = Tuning.of(MODEL)
    exact = fit("kf", tuning, [Recording(log_of(ys))], wanted=("Q", "R.float"), blocks=0)
    monkeypatch.setattr("estimators.fit.fit.maximise", lambda *_: pytest.fail("by slopes"))
    drawn = fit(
        "enkf", tuning.with_options({"members": 400.0}), [Recording(log_of(ys))], wanted=("Q", "R.float"), blocks=0
    )
    for line, other in zip(exact.lines, drawn.lines, strict=True):
        # Chance of the members moves the maximum by much less than the data leave open.
        assert abs(np.log(other.after / line.after)) < line.deviation


assert DECADES == 2.0 * DECADE
