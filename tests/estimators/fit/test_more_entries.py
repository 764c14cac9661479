"""Entries beside Q, R and parameters: options, the prior, how long errors last; and a search without slopes.

How much of a likelihood is believed: the maximum at a power, and which power is chosen.
"""

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

from estimators.errors import ConfigError
from estimators.fit.aims import LIKELIHOOD, Aim
from estimators.fit.entries import Setting, entries_of, with_values
from estimators.fit.fit import fit
from estimators.fit.judge import MIN_SIGMAS, POWERS, PartScore, Worth, at_power, gain, tempered, verdict, worths
from estimators.fit.objective import Objective, maximise, search
from estimators.fit.recording import Recording, held_out_rows
from estimators.fit.uncertainty import curvature
from estimators.model.coloured import ColouredError, coloured
from estimators.tuning import Tuning
from tests.estimators.fit.test_fit import DECADES, MODEL, dense, log_of, objective_of, simulated

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


@pytest.fixture(scope="module")
def climbed():
    ys = simulated(1, 200)
    tuning = Tuning.of(MODEL).set("Q.level", 0.15).set("R.float", 0.6)
    objective = objective_of(log_of(ys), "Q", "R.float", tuning=tuning)
    x, _ = maximise(objective, objective.start)
    return ys, objective, x, curvature(objective, x)


@pytest.mark.parametrize("power", [1.0, 0.25, 1e-2, 1e-4])
def test_the_maximum_at_a_power_is_that_of_the_dense_density_to_the_power(climbed, power):
    ys, objective, x, shape = climbed
    start = np.log([0.15, 0.6])

    def loss(theta):
        return -power * dense(ys, *np.exp(theta)) + 0.5 * float(np.sum(((theta - start) / DECADES) ** 2))

    best = minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-8}).x
    found, _ = at_power(objective, x, shape, power)
    # A parabola in place of the hill: what it misses is of second order in how far the maximum is from the start.
    assert np.all(np.abs(found - best) < 0.02 + 0.25 * np.max(np.abs(x - start)) ** 2)


def test_the_powers_lead_back_to_the_start(climbed):
    _, objective, x, shape = climbed
    far = [np.max(np.abs(at_power(objective, x, shape, power)[0] - objective.start)) for power in (*POWERS, 1e-9)]
    assert far[-1] < 1e-4 and far[0] == np.max(np.abs(x - objective.start))


def test_what_is_not_proposed_is_told_of_the_whole_likelihood():
    right = Tuning.of(MODEL).set("Q.level", 0.2).set("R.float", 0.5)
    found = fit("kf", right, [Recording(log_of(simulated(0, 300)))])
    assert not found.proposed and found.power == 1.0 and found.verdict.reasons


@pytest.mark.parametrize("gained, said", [(1e-4, "negligible gain: 0.02 nats in total"), (0.1, None)])
def test_a_little_of_a_gain_is_none(gained, said):
    """A small enough step towards what is better is surely better, and worth nothing: it is not proposed."""

    def worth(each):
        terms = np.full(200, each)
        part = PartScore(200, each, 1.0, 0.95, terms, terms, {}, {}, {})
        return Worth(part, part)

    found = verdict(worth(0.0), worth(gained), Aim())
    assert (found.proposed, found.reasons) == (said is None, () if said is None else (said,))


def two_sensors(seed: int, *, truth: bool, drift: float) -> Recording:
    """Return a recording of both sensors of one walk; a drift of the second makes their likelihood overconfident."""
    ys = simulated(seed, 240)
    log = log_of(ys)
    rng = np.random.default_rng(100 + seed)
    slow = drift * np.cumsum(rng.normal(size=ys.size)) / np.sqrt(ys.size)
    log.add("silent", np.arange(ys.size, dtype=float) + 0.5, ys + slow + rng.normal(0.0, 0.3, ys.size))
    if truth:
        log.add_truth(np.arange(ys.size, dtype=float) + 0.7, level=ys)
    return Recording(log, 1.0, held_out_rows(log))


@pytest.mark.parametrize("truth", [False, True])
@pytest.mark.parametrize("seed, drift", [(0, 0.0), (1, 1.0), (2, 3.0), (3, 8.0)])
def test_the_power_is_the_one_that_scores_of_all_powers_with_all_sensors_choose(seed, drift, truth):
    """Sensors are held out in turn only where that can decide, which saves folds and must not change the choice."""
    recording, folds = two_sensors(seed, truth=truth, drift=drift), []
    tuning = Tuning.of(MODEL).set("Q.level", 0.02).set("R.float", 2.0)
    entries, _ = entries_of("kf", tuning, [recording.log], ("Q", "R"))
    objective = Objective("kf", tuning, tuple(entries), (recording,), go=lambda done: not folds.append(done))
    x, _ = maximise(objective, objective.start)
    shape = curvature(objective, x)

    def setting(point: np.ndarray) -> Setting:
        return with_values(tuning, entries, [item.outward(value) for item, value in zip(entries, point, strict=True)])

    points = [at_power(objective, x, shape, power)[0] for power in POWERS]
    own, *others = worths("kf", [setting(p) for p in (objective.start, *points)], [recording], lambda done: True)
    verdicts = [verdict(own, other, Aim()) for other in others]
    harmless = [k for k in range(len(POWERS)) if verdicts[k].harmless]
    best = max(harmless, key=lambda k: verdicts[k].gain, default=0)
    differences = [gain(other.held_out.aimed, others[best].held_out.aimed) for other in others]
    as_good = [k for k in harmless if differences[k][0] <= MIN_SIGMAS * differences[k][1]]
    folds.clear()
    found = tempered(objective, x, shape, setting, [recording])
    assert objective.aim.kind == LIKELIHOOD and found.power == POWERS[as_good[0] if as_good else 0]
    k = POWERS.index(found.power)
    assert found.verdict == verdicts[k]
    assert repr(found.before) == repr(own) and repr(found.after) == repr(others[k])
    # All ten settings, and two sensors in turn of the start and the chosen one.
    assert sum(folds) == 10 + 2 * 2 if truth else 10 + 2 * 2 <= sum(folds) <= 10 * (1 + 2)
