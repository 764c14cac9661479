"""A fit beside a running twin: the same as the fit of its log alone, told, cancelled, refused.

Around a knob: every point against a fold of its own, the optimum against all of them, and when it is given up.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from app.derive.refits import Fitting
from app.derive.sweep import (
    FACTORS,
    MATCHED_R_KEY,
    MATCHING_TOLERANCE,
    Point,
    Sweeps,
    Swept,
    noise,
    scaled,
    value_of,
    values_around,
)
from app.engine import history_copy
from app.engine.jobs import CANCELLED, DONE, FAILED, Job, JobCancelled
from estimators.errors import ConfigError
from estimators.fit.fit import fit
from estimators.fit.recording import Recording
from estimators.fold import Fold, fold
from estimators.models import MODELS
from estimators.track import USED
from estimators.tuning import Tuning
from tests.app.scripted import MODEL, Stepped, random_walk, readings, twin
from tests.support import as_log, folded

FIRST = Tuning.of(MODEL)
WANTED = ["Q.rate", "R.winding"]


def walk(n):
    return readings(*random_walk(n, seed=3, step=0.05))


def started(n):
    return Stepped(n, seed=3, step=0.05).engine


def fitted(engine, *request):
    """The attempt at the end of a fit."""
    fitting = Fitting(engine)
    fitting.begin(*request)
    engine.settle()
    assert fitting.latest.job.over
    return fitting.latest


def alone(n):
    log = as_log(walk(n))
    return fit("kf", FIRST, [Recording(log)], wanted=WANTED)


def test_a_fit_beside_the_twin_is_the_fit_of_its_log(monkeypatch):
    monkeypatch.setattr(history_copy, "MAX_PULL_ROWS", 4096)
    n = 5000  # more than one chunk is copied
    engine = started(n)
    found, expected = fitted(engine, WANTED), alone(n)
    assert (found.job.state, found.events, found.folds) == (DONE, n, expected.folds)
    assert found.seconds == pytest.approx(0.1 * (n - 1)) and found.job.elapsed > 0.0
    assert found.fitted.lines == expected.lines
    assert found.fitted.verdict == expected.verdict
    # Nothing was applied.
    assert engine.tuning is engine.twin.tuning and engine.revisions.runs[-1].number == 0


def test_the_last_events_are_folded_from_a_snapshot_on():
    found = fitted(started(6000), WANTED, 3000)
    assert found.job.state == DONE and found.fitted.before.fitted.n + found.fitted.before.held_out.n == found.events
    # From the last snapshot at or before the event that was asked for.
    assert 3000 <= found.events < 6000


def test_a_data_sheet_bounds_it():
    engine = started(1500)
    free = alone(1500).lines[1].after
    # R was found below where the data sheet ends.
    bounds = (1.2 * free, FIRST.get("R.winding"))
    engine.twin.config.sensors = {"winding": SimpleNamespace(bounds=bounds, offset=None, scale=None)}
    line = fitted(engine, WANTED).fitted.lines[1]
    assert free < bounds[0] <= line.after <= bounds[1]


def test_one_at_a_time():
    engine = started(600)
    fitting = Fitting(engine)
    fitting.begin(WANTED)
    with pytest.raises(ConfigError, match="another one is under way; wait for it, or cancel it"):
        fitting.begin(WANTED)
    fitting.cancel()
    engine.settle()
    assert (fitting.latest.job.state, fitting.latest.fitted, fitting.latest.job.reason) == (CANCELLED, None, "")
    fitting.begin(WANTED)
    engine.settle()
    assert fitting.latest.job.state == DONE and fitting.latest.number == 2


def test_a_fit_that_is_cancelled_ends_after_its_current_folds(monkeypatch):
    engine = started(600)
    fitting = Fitting(engine)
    real = Fold.advance

    def advance(fold, *count):
        if fitting.latest is not None and fitting.latest.folds:
            fitting.cancel()
        return real(fold, *count)

    monkeypatch.setattr(Fold, "advance", advance)
    fitting.begin(WANTED)
    engine.settle()
    assert (fitting.latest.job.state, fitting.latest.fitted) == (CANCELLED, None)
    assert 0 < fitting.latest.folds < alone(600).folds


@pytest.mark.parametrize(
    ("n", "wanted", "reason"),
    [(0, WANTED, "no reading has come yet"), (600, ["Q.nothing"], "Q.nothing is no entry that can be fitted")],
)
def test_why_there_is_none(n, wanted, reason):
    found = fitted(started(n), wanted)
    assert found.job.state == FAILED and reason in found.job.reason


def test_an_empty_request_is_rejected():
    with pytest.raises(ConfigError, match="wanted is empty"):
        Fitting(Stepped().engine).begin([])


def brute_force(key, n):
    """Log-likelihood and mean NIS of a whole fold for each factor, from the prior."""
    log = as_log(walk(n))
    found = {}
    for factor in FACTORS:
        track = fold("kf", MODEL, FIRST.set(key, FIRST.get(key) * factor), log)
        used = track.verdict == USED
        found[factor] = (track.log_likelihood[used].sum(), track.nis[used].mean())
    return found


@pytest.mark.parametrize("key", ["Q.rate", "R.winding"])
def test_every_point_is_a_fold_and_the_best_is_the_best(key):
    engine = started(1500)
    sweeps = Sweeps(engine)
    assert sweeps.around(key).points == ()
    sweeps.sweep(key, Job("test"))
    swept, expected = sweeps.around(key), brute_force(key, 1500)
    assert swept.done and swept.events == 1500 and [point.factor for point in swept.points] == list(FACTORS)
    for point in swept.points:
        likelihood, nis = expected[point.factor]
        assert point.log_likelihood == pytest.approx(likelihood, rel=1e-12)
        assert point.nis == pytest.approx(nis, rel=1e-12)
        assert point.value == pytest.approx(point.factor * FIRST.get(key))
    assert swept.best.factor == max(FACTORS, key=lambda factor: expected[factor][0])


def test_a_window_goes_on_from_a_snapshot_as_the_whole_fold_did():
    engine = started(6000)
    taken = engine.last_events(3000, rows=True)
    assert len(taken.events) <= 3000 and taken.first % 1024 == 0
    again = taken.fold()
    again.advance()
    np.testing.assert_array_equal(again.track.mean, taken.track.mean)
    log = as_log(walk(6000))
    whole = folded("kf", MODEL, log, FIRST)
    np.testing.assert_array_equal(again.track.mean, whole.track.mean[taken.first :])


def test_another_tuning_ends_a_sweep():
    engine = started(1500)
    sweeps = Sweeps(engine)
    engine.tuning = FIRST.set("Q.rate", 0.5)
    with pytest.raises(JobCancelled):
        sweeps.sweep("Q.rate", Job("test"))
    assert sweeps.around("Q.rate").points == ()


def test_what_is_too_slow_says_so(monkeypatch):
    engine = started(600)
    sweeps = Sweeps(engine)
    monkeypatch.setattr("app.derive.sweep.MAX_VALUE_TIME_S", 0.0)
    sweeps.sweep("Q.rate", Job("test"))
    found = sweeps.around("Q.rate")
    assert found.done and not found.points and "too slow to be folded again" in found.reason


def test_one_job_folds_all_that_was_asked_for(monkeypatch):
    monkeypatch.setattr("app.derive.sweep.SETTLE_TIME_S", 0.0)
    engine = started(600)
    sweeps = Sweeps(engine)
    sweeps.around("R.winding")
    sweeps.around("Q.rate")
    assert engine.jobs.step() and not engine.jobs.step()
    assert sweeps.around("Q.rate").done and sweeps.around("R.winding").done and not engine.jobs.step()


def test_a_group_is_scaled_as_a_whole():
    q, r = scaled(FIRST, "Q", 2.0), scaled(FIRST, "R", 0.5)
    np.testing.assert_allclose(q.q, 2.0 * FIRST.q)
    np.testing.assert_allclose(r.r, 0.5 * FIRST.r)
    assert np.all(q.r == FIRST.r) and np.all(r.q == FIRST.q)


def test_values_outside_a_range_are_left_out_and_zero_has_none():
    tuning = Tuning.of(MODELS["motor_drive"])
    for parameter in tuning.model.parameters:
        key = f"p.{parameter.name}"
        found = sorted(value_of(turned, key) for _, turned in values_around(tuning, key))
        inside = [parameter.value * factor for factor in FACTORS]
        inside = [value for value in inside if parameter.low <= value <= parameter.high]
        assert found == pytest.approx(sorted(inside))
    # 0.3, which must lie between 0 and 0.4.
    assert [factor for factor, _ in values_around(tuning, "p.iron_magnet")] == [1.0, 0.5, 0.2, 0.1]
    assert values_around(FIRST.set("Q.rate", 0.0), "Q.rate") == []
    assert values_around(FIRST, "Q.rate")[0][0] == 1.0


@pytest.mark.parametrize("key", ["gate", "use.winding", "gate.kind", "Q.nothing", ""])
def test_what_is_no_number_is_refused(key):
    with pytest.raises(ConfigError):
        value_of(FIRST, key)


def test_the_level_is_where_the_nis_is_one_between_two_points():
    points = [Point(f, f, -1.0, 0.5 * f**-0.5) for f in FACTORS]
    assert Swept("Q", 0, 1.0, 100, tuple(points), True).level == pytest.approx(0.25, rel=1e-9)
    assert Swept("Q", 0, 1.0, 100, tuple(points[3:]), True).level is None


def test_a_value_at_which_readings_fail_is_never_the_best():
    swept = Swept("Q", 0, 1.0, 9, (Point(1.0, 1.0, -5.0, 1.0), Point(2.0, 2.0, None, None)), True)
    assert swept.best.factor == 1.0


def test_what_the_innovations_say_of_r_is_given_by_key():
    engine = started(1500)
    found = noise(engine, Sweeps(engine))
    # The readings are of a random walk with noise of variance 1.
    estimate = found.sensors["R.winding"]
    track = engine.last_events(2048, rows=True).track
    weight = track.innovation_std[:, 0] ** -4
    excess = np.sum(weight * (track.innovation[:, 0] ** 2 - track.innovation_std[:, 0] ** 2)) / np.sum(weight)
    assert found.reason == "" and estimate.n == 1500
    assert estimate.variance == pytest.approx(FIRST.get("R.winding") + excess, rel=1e-9)


@pytest.mark.parametrize(("r", "q", "doubted"), [(1.0, 1.0, False), (25.0, 1.0, False), (1.0, 1e-4, True)])
def test_an_r_that_is_wrong_alone_is_mended_and_a_wrong_q_is_not_laid_to_r(r, q, doubted):
    """Readings as the model says, of noise of variance 1, folded with `r` and a factor `q` of all of Q."""
    own = twin()
    own.tuning = scaled(FIRST.set("R.winding", r), "Q", q)
    stepped = Stepped(of=own)
    rng = np.random.default_rng(3)
    n, dt, x, values = 4000, 0.1, np.array([40.0, 0.0]), []
    for _ in range(n):
        x = np.array([[1.0, dt], [0.0, 1.0]]) @ x + rng.normal(size=2) * np.sqrt(FIRST.q * dt)
        values.append(x[0] + rng.normal())
    stepped.put(readings(dt * np.arange(1, n + 1), np.array(values)))
    engine = stepped.engine
    sweeps = Sweeps(engine)
    as_it_is = noise(engine, sweeps)
    assert bool(as_it_is.doubts) == (r > 1.0 or doubted)  # a gain that is wrong leaves a correlation
    sweeps.sweep(MATCHED_R_KEY, Job("test"))
    found = noise(engine, sweeps)
    assert bool(found.doubts) == doubted
    if not doubted:
        # Four standard errors of the mean square of 4,000 innovations, and what is left at rest.
        assert found.sensors["R.winding"].variance == pytest.approx(
            1.0, abs=4 * np.sqrt(2 / n) * 1.2 + MATCHING_TOLERANCE
        )
