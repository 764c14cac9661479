"""How much of a likelihood is believed: the maximum at a power, and which power is chosen."""

import numpy as np
import pytest
from scipy.optimize import minimize

from estimators.fit.aims import LIKELIHOOD, Aim
from estimators.fit.entries import Setting, entries_of, with_values
from estimators.fit.fit import fit
from estimators.fit.judge import MIN_SIGMAS, POWERS, PartScore, Worth, at_power, gain, tempered, verdict, worths
from estimators.fit.objective import Objective, maximise
from estimators.fit.recording import Recording, held_out_rows
from estimators.fit.uncertainty import curvature
from estimators.tuning import Tuning
from tests.estimators.fit.test_fit import DECADES, MODEL, dense, log_of, objective_of, simulated


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
