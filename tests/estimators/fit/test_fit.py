"""A fit against the dense joint Gaussian of a random walk, maximised by another route; what is left alone; what judges.

The walk x_k = a x_k-1 + w, y_k = x_k + v has y ~ N(H m, H P Hᵀ + R) as a whole, with no filter anywhere.
"""

import warnings
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.optimize import brentq, minimize
from scipy.stats import binom

from estimators.diagnostics.health import HealthPolicy
from estimators.errors import ConfigError
from estimators.fit.aims import track_of
from estimators.fit.entries import Setting, entries_of
from estimators.fit.fit import fit
from estimators.fit.judge import POWERS, gain
from estimators.fit.objective import SHARES, Cancelled, FitProgress, Objective, quasi_newton
from estimators.fit.recording import Recording, held_out_rows, without_queries
from estimators.fold import Fold
from estimators.log import READING, Log
from estimators.model.state_space import Parameter
from estimators.track import Track
from estimators.tuning import Tuning
from tests.benchmarks.recovery import CASES, recover
from tests.models import level_model
from tests.support import folded, measured

DECADES = 2.0 * np.log(10.0)
"""Deviation of the weak belief in a variance."""


def walk(x, u, p, dt, out):
    out[0] = x[0] * (1.0 - dt * p[0])


def level(x, u, p, out):
    out[0] = x[0] + p[1]


MODEL = level_model(
    {"float": 1.0, "silent": 1.0}, 0.5, name="walk", std=2.0, h=level, f=walk, linear=True,
    parameters=(Parameter("rate", "1/s", 0.1, 0.0, 1.0), Parameter("offset", "m", 0.0, -5.0, 5.0)),
)  # fmt: skip


def simulated(seed: int, n: int, q: float = 0.2, r: float = 0.5, rate: float = 0.1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x, ys = rng.normal(0.0, 2.0), np.empty(n)
    for k in range(n):
        if k:
            x = (1.0 - rate) * x + rng.normal(0.0, np.sqrt(q))
        ys[k] = x + rng.normal(0.0, np.sqrt(r))
    return ys


def log_of(ys: np.ndarray) -> Log:
    return measured(MODEL, "float", np.arange(ys.size, dtype=float), ys)


def objective_of(log: Log, *wanted: str, tuning: Tuning | None = None, **given: Any) -> Objective:
    """The objective of these entries on a whole log; `given` are further arguments of `Objective`."""
    tuning = tuning or Tuning.of(MODEL)
    entries, _ = entries_of("kf", tuning, [log], wanted)
    return Objective("kf", tuning, tuple(entries), (Recording(log, 1.0, np.zeros(log.n, bool)),), **given)


@lru_cache
def covariances(n: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the states, from the prior and from process noise of variance 1, each (n, n)."""
    a = 1.0 - rate
    variance = np.zeros((2, n))
    variance[0, 0] = 4.0
    for k in range(1, n):
        variance[:, k] = a * a * variance[:, k - 1] + (0.0, 1.0)
    i, j = np.indices((n, n))
    prior, noise = a ** np.abs(i - j) * variance[:, np.minimum(i, j)]
    return prior, noise


def dense(ys: np.ndarray, q: float, r: float, rate: float = 0.1) -> float:
    """Log density of all readings at once."""
    n = ys.size
    prior, noise = covariances(n, rate)
    factor = np.linalg.cholesky(prior + q * noise + r * np.eye(n))
    z = solve_triangular(factor, ys, lower=True)
    return float(-0.5 * z @ z - np.log(np.diag(factor)).sum() - 0.5 * n * np.log(2.0 * np.pi))


def penalised(ys: np.ndarray, x: np.ndarray) -> float:
    """As the fit has it, of the logarithms of q and r, which start at 0.5 and 1."""
    start = np.log([0.5, 1.0])
    return dense(ys, *np.exp(x)) - 0.5 * float(np.sum(((x - start) / DECADES) ** 2))


@pytest.fixture(scope="module")
def ys():
    return simulated(1, 150)


@pytest.fixture(scope="module")
def best(ys):
    return minimize(lambda x: -penalised(ys, x), np.log([0.3, 0.4]), method="Nelder-Mead", options={"xatol": 1e-6}).x


@pytest.fixture(scope="module")
def fitted(ys):
    return fit("kf", Tuning.of(MODEL), [Recording(log_of(ys))], wanted=("Q", "R"), blocks=0)


def test_the_objective_is_the_joint_density(ys):
    objective = objective_of(log_of(ys), "Q", "R")
    for x in (np.log([0.5, 1.0]), np.log([0.01, 3.0])):
        # Rounding of 150 terms, each exact to 1e-12.
        assert objective.value(x) == pytest.approx(penalised(ys, x), abs=1e-8)


def test_the_maximum_is_that_of_the_joint_density(fitted, best):
    after = np.log([line.after for line in fitted.lines])
    # The optimiser stops within 0.02 deviations of the maximum; the other one is exact to 1e-4.
    deviation = np.array([line.deviation for line in fitted.lines])
    assert np.all(np.abs(after - best) < 0.05 * deviation)


def test_intervals_are_where_the_profile_of_the_joint_density_has_dropped(fitted, best, ys):
    top = penalised(ys, best)

    def dropped(t, i):
        other = minimize(lambda z: -penalised(ys, np.insert(z, i, t)), best[1 - i : 2 - i], method="Nelder-Mead")
        return 2.0 * (top + other.fun) - 1.96**2

    for i, line in enumerate(fitted.lines):
        for end, far in ((line.low, -3.0), (line.high, 3.0)):
            exact = brentq(dropped, best[i], best[i] + far, args=(i,), xtol=1e-3)
            # A parabola is believed where its root is right to 20 %.
            assert abs(np.log(end) - exact) < 0.2 * abs(exact - best[i])


def test_a_sensor_that_says_nothing_is_not_fitted(fitted):
    assert [item.key for item in fitted.skipped] == ["R.silent"]
    assert "without readings" in fitted.skipped[0].reason


def test_what_the_data_cannot_tell_is_left_alone(ys):
    # Twelve readings of a walk say next to nothing of the rate at which it returns.
    found = fit("kf", Tuning.of(MODEL), [Recording(log_of(ys[:12]))], wanted=("Q", "p.rate"), blocks=0)
    line = {line.key: line for line in found.lines}["p.rate"]
    assert line.alone and not line.told and line.after == line.before


def test_without_blocks_held_out_nothing_is_proposed(fitted):
    assert not fitted.proposed and "no data were held out" in fitted.verdict.reasons[0]


def test_a_tuning_that_is_wrong_is_replaced():
    wrong = Tuning.of(MODEL).set("Q.level", 0.005).set("R.float", 8.0)
    found = fit("kf", wrong, [Recording(log_of(simulated(2, 600)))], wanted=("Q", "R"))
    # Its readings are independent news, and the blocks held out say so.
    assert found.proposed and found.power >= POWERS[3]
    assert found.after.held_out.log_density > found.before.held_out.log_density
    for line, truth in zip(found.lines, (0.2, 0.5), strict=True):
        assert line.low < truth < line.high


def test_a_tuning_that_is_right_stays():
    right = Tuning.of(MODEL).set("Q.level", 0.2).set("R.float", 0.5)
    proposed = [fit("kf", right, [Recording(log_of(simulated(seed, 300)))]).proposed for seed in range(10)]
    # Two standard errors are exceeded by chance once in 40.
    assert sum(proposed) <= 1


def test_a_sensor_that_is_stuck_tells_no_noise(ys):
    """It predicts itself so well that its R would run to nothing, and win on what was held out."""
    stuck, moves = log_of(np.full(300, 1.3)), log_of(ys)
    with pytest.raises(ConfigError, match="R.float belongs to a sensor whose readings never change"):
        entries_of("kf", Tuning.of(MODEL), [stuck], ["R"])
    assert [item.key for item in entries_of("kf", Tuning.of(MODEL), [stuck, moves], ["R"])[0]] == ["R.float"]


def test_several_logs_weigh_as_they_should(ys):
    one = fit("kf", Tuning.of(MODEL), [Recording(log_of(ys), 2.0)], blocks=0)
    two = fit("kf", Tuning.of(MODEL), [Recording(log_of(ys)), Recording(log_of(ys))], blocks=0)
    for line, other in zip(one.lines, two.lines, strict=True):
        # Each is within 0.02 deviations of the one maximum.
        assert abs(np.log(line.after / other.after)) < 0.05 * line.deviation


def test_a_fit_can_be_cancelled(ys):
    told = []

    def go(folds):
        told.append(folds)
        return len(told) < 5

    with pytest.raises(Cancelled):
        fit("kf", Tuning.of(MODEL), [Recording(log_of(ys))], go=go)
    # Those under way on other threads may still say so.
    assert len(told) < 15


def test_progress_counts_every_fold_and_the_gain_of_the_search(ys, fitted):
    told = FitProgress()
    found = fit("kf", Tuning.of(MODEL), [Recording(log_of(ys))], wanted=("Q", "R"), blocks=0, progress=told)
    assert found.folds == told.folds == told.expected
    start, after = (penalised(ys, np.log([values[k] for values in told.values.values()])) for k in (0, 1))
    assert told.gain == pytest.approx(after - start, abs=1e-6)


def test_derivatives_at_the_last_points_are_not_folded_again(ys):
    folds = []

    def count(done: int) -> bool:
        folds.append(done)
        return True

    objective = objective_of(log_of(ys), "Q", "R", go=count)
    here, there = objective.start, objective.start + 0.1
    before = [objective.slopes(point) for point in (here, there, here, there)]
    assert sum(folds) == 2 * 3
    # An objective with an entry fixed is another one.
    assert objective.pinned([0], here).slopes(here[1:])[1].shape[0] == 1 and sum(folds) == 2 * 3 + 2
    assert before[0] is before[2] and before[1] is before[3] and not np.array_equal(before[0][1], before[1][1])


def test_a_step_does_not_fold_the_point_again_that_it_has_tried(ys):
    objective, points = objective_of(log_of(ys), "Q", "R"), []
    work = objective.work
    object.__setattr__(objective, "work", lambda point: points.append(point[1]) or work(point))
    quasi_newton(objective, objective.start)
    assert len(set(points)) == len(points) > 2 * (2 + len(SHARES))


@pytest.mark.parametrize("estimator", ["kf", "filterpy-kf"])
def test_a_fold_that_judges_no_rows_is_the_same_bits_in_all_other_columns(ys, estimator):
    log, setting = log_of(ys), Setting(Tuning.of(MODEL).set("gate", 0.9), None)
    fold = folded(estimator, MODEL, log, setting.tuning)
    found = track_of(estimator, setting, Recording(log))
    judged = {"age", "nis_mean", "nis_low", "nis_high", "consistency", "health", "alarms", "flags"}
    for name, here, there in zip(Track._fields, found, fold.track, strict=True):
        assert name in judged or np.array_equal(here, there, equal_nan=True), name
    quiet = Fold(estimator, MODEL, setting.tuning, log, policy=HealthPolicy(window=0))
    before = quiet.evidence
    quiet.advance()
    assert np.array_equal(quiet.evidence, before, equal_nan=True)
    assert not np.array_equal(fold.evidence, before, equal_nan=True)


def test_a_stopped_fit_judges_the_best_point_so_far(ys):
    wrong = Tuning.of(MODEL).set("Q.level", 0.005).set("R.float", 8.0)
    told = FitProgress()

    def stop(folds: int) -> bool:
        told.stop = told.gain > 0.0
        return True

    found = fit("kf", wrong, [Recording(log_of(simulated(2, 600)))], go=stop, progress=told)
    assert found.stopped and found.proposed
    # Three gradients of three folds each, the scores there, and ten settings to judge.
    assert found.folds < 30
    assert told.values["R.float"][0] == 8.0 and told.values["R.float"][1] < 8.0
    assert found.lines[1].after < 8.0
    assert all(line.low < line.after < line.high for line in found.lines)


def test_blocks_are_of_one_length_and_the_last_is_held_out(ys):
    log = log_of(ys)
    log.add_truth([500.0], level=1.0)
    held = held_out_rows(log, 9)
    # 150 readings in 9 blocks are 16 or 17 each; every third of them.
    lengths = np.diff(np.flatnonzero(np.diff(held[:-1], prepend=False, append=False)))[::2]
    assert lengths.size == 3 and set(lengths.tolist()) <= {16, 17} and held[-1] and not held[0]


def test_queries_are_no_part_of_what_is_folded_again(ys):
    log = log_of(ys)
    log.add_truth(np.arange(150.0) + 0.5, level=ys)
    lean = without_queries(log)
    assert lean.n == 150 and np.all(lean.kind[:150] == READING) and log.n == 300


def test_an_entry_that_is_none_is_refused(ys):
    with pytest.raises(ConfigError, match="R.flot is no entry that can be fitted; did you mean R.float"):
        fit("kf", Tuning.of(MODEL), [Recording(log_of(ys))], wanted=("R.flot",))


LOGS = 6


@pytest.fixture(scope="module")
def recovered():
    return recover(next(case for case in CASES if case.twin == "motor_winding"), LOGS)


def test_true_noises_lie_in_their_intervals(recovered):
    found, told = recovered, sum(recovered.told.values())
    # All three are told by 1500 readings. Fewer inside than this would come by chance once in a thousand.
    assert told == 3 * LOGS
    assert sum(found.inside.values()) >= binom.ppf(1e-3, told, 0.95)
    # NIS on a log that was not fitted: 99 % bounds.
    assert found.consistent >= LOGS - 1


def test_a_fit_makes_the_nis_of_another_log_as_uncertain_as_its_readings_do(recovered):
    """With the information I of a fit, ∂(mean NIS)/∂θ is -(2 / N) I e along the scale e of all noises, so gᵀ I⁻¹ g is
    2 / N: the variance of a chi-square's mean once more, whatever the model, if all Q and R are fitted."""
    # The belief takes from it, the sandwich adds, by a few percent each. Not of the fifth log, in which Q.rate is close
    # to zero: its interval spans a factor of 22, over which the NIS is no linear function of its logarithm.
    others = np.delete(recovered.wider, 4)
    np.testing.assert_allclose(others, np.sqrt(2.0), rtol=0.15)


def test_the_gain_of_no_measurements_has_no_error_and_no_warning():
    """As where no block is held out; NumPy would warn of the deviation of nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mean, error = gain(np.empty(0), np.empty(0))
    assert mean == 0.0 and np.isnan(error)
    assert gain(np.zeros(3), np.array([1.0, 2.0, 3.0])) == (2.0, pytest.approx(np.sqrt(2.0 / 3.0) / np.sqrt(2.0)))
