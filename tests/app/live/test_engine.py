"""The engine: whatever order, pieces, retunes and failures, the track is the fold of the log."""

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest

from app.live import commands
from app.live.alerts import Alerts
from app.live.engine import Engine
from app.live.notices import Notices
from app.twin.twin import load_twin
from estimators.fold import Fold, fold
from estimators.log import READING, Events, Log
from estimators.track import DIVERGED, FAILED, USED
from estimators.tuning import Tuning
from tests.app.scripted import MODEL, Scripted, fresh_status, pull_all, readings, row_count, twin, wait_for
from tests.support import SECOND, assert_same


@pytest.fixture
def started():
    engines = []

    def start(source, **options):
        engine = Engine(twin(**options), lambda report: source)
        engines.append(engine)
        engine.start()
        return engine

    yield start
    for engine in engines:
        engine.stop()


def series(n, seed=1):
    rng = np.random.default_rng(seed)
    return np.arange(1, n + 1) * 0.01, 40 + np.cumsum(rng.normal(size=n)) * 0.1 + rng.normal(size=n)


def reference(times, values, estimator="kf", tuning=None):
    log = Log(1)
    log.extend(readings(times, values))
    return fold(estimator, MODEL, tuning or Tuning.of(MODEL), log, pairs=np.array([[0, 1]]))


def test_live_in_pieces_out_of_order_equals_one_fold(started):
    times, values = series(3000)
    source = Scripted()
    engine = started(source)
    rng = np.random.default_rng(0)
    late = rng.choice(np.arange(100, 3000), 40, replace=False)
    prompt = np.setdiff1d(np.arange(3000), late)
    order = np.concatenate((prompt, late))
    # Each late reading comes about 0.3 s after its time, within the horizon of 2 s.
    order = order[np.argsort(np.where(np.isin(order, late), times[order] + 0.3, times[order]), kind="stable")]
    at = 0
    while at < order.size:
        size = int(rng.integers(1, 60))
        piece = order[at : at + size]
        source.put(readings(times[piece], values[piece]))
        at += size
    wait_for(lambda: row_count(engine) == 3000)
    assert_same(pull_all(engine).track, reference(times, values))


def test_cursor_is_taken_back_by_a_late_reading(started):
    source = Scripted()
    engine = started(source)
    cursor = engine.cursor()
    source.put(readings([1.0, 2.0, 3.0], [40, 41, 42]))
    wait_for(lambda: row_count(engine) == 3)
    assert engine.pull(cursor).first == 0
    source.put(readings([2.5], [41.5]))
    wait_for(lambda: row_count(engine) == 4)
    again = engine.pull(cursor)
    assert not again.fresh
    assert again.first == 2
    np.testing.assert_array_equal(again.events.t, np.array([2.5, 3.0]) * SECOND)


def test_a_cursor_with_a_span_begins_near_the_end(started):
    """Also of the next revision; rows that come, or are rewritten, it gets all."""
    source = Scripted()
    engine = started(source)
    source.put(readings(np.arange(1.0, 101.0), np.full(100, 40.0)))
    wait_for(lambda: row_count(engine) == 100)
    cursor = engine.cursor(span=10 * SECOND)
    for revision in (0, 1):
        pull = engine.pull(cursor)
        assert (pull.fresh, pull.revision, pull.first, len(pull.events)) == (True, revision, 89, 11)
        np.testing.assert_array_equal(pull.events.t, np.arange(90, 101) * SECOND)
        if not revision:
            engine.submit(commands.SetTuning("R.winding", 9.0))
            wait_for(lambda: engine.status().revision == 1)
    source.put(readings([99.5], [40.0]))
    wait_for(lambda: row_count(engine) == 101)
    late = engine.pull(cursor)
    assert (late.fresh, late.first, len(late.events)) == (False, 99, 2)


def test_readings_beyond_the_horizon_are_counted_and_dropped(started):
    source = Scripted()
    engine = started(source)
    source.put(readings([10.0, 7.9, 7.5, 8.1], [40, 41, 43, 42]))
    wait_for(lambda: row_count(engine) == 2)
    wait_for(lambda: engine.notices.counts().get("stale") == 2)
    np.testing.assert_array_equal(pull_all(engine).events.t, np.array([8.1, 10.0]) * SECOND)


@pytest.mark.parametrize(
    ("command", "estimator", "tuned"),
    [
        (commands.SetEstimator("ukf"), "ukf", lambda tuning: tuning),
        (commands.SetTuning("Q.rate", 0.1), "kf", lambda tuning: tuning.set("Q.rate", 0.1)),
        (commands.UseSensor("winding", False), "kf", lambda tuning: tuning.set("use.winding", False)),
    ],
)
def test_refold_replaces_the_whole_history(started, command, estimator, tuned):
    times, values = series(2000)
    source = Scripted()
    engine = started(source)
    source.put(readings(times, values))
    wait_for(lambda: row_count(engine) == 2000)
    before = pull_all(engine)
    cursor = engine.cursor()
    engine.pull(cursor)
    engine.submit(command)
    wait_for(lambda: pull_all(engine).revision == 1)
    pull = engine.pull(cursor)
    assert pull.fresh and pull.first == 0
    assert_same(pull.track, reference(times, values, estimator, tuned(Tuning.of(MODEL))))
    previous = engine.previous()
    assert_same(previous.track, before.track)


def test_readings_that_come_during_a_refold_are_not_lost(started):
    times, values = series(60_000)
    source = Scripted()
    engine = started(source)
    source.put(readings(times[:50_000], values[:50_000]))
    wait_for(lambda: row_count(engine) == 50_000)
    engine.submit(commands.SetTuning("Q.rate", 0.01))
    late = [50_850, 50_900]
    for start in range(50_000, 60_000, 250):
        piece = np.setdiff1d(np.arange(start, start + 250), late)
        source.put(readings(times[piece], values[piece]))
        if start == 50_750:
            source.put(readings(times[late], values[late]))
    wait_for(lambda: row_count(engine) == 60_000 and not engine.status().refolding)
    assert_same(pull_all(engine).track, reference(times, values, "kf", Tuning.of(MODEL).set("Q.rate", 0.01)))


def test_of_many_slider_values_the_last_one_holds(started):
    times, values = series(5000)
    source = Scripted()
    engine = started(source)
    source.put(readings(times, values))
    wait_for(lambda: row_count(engine) == 5000)
    for value in np.geomspace(1e-4, 1e-1, 50):
        engine.submit(commands.SetTuning("Q.rate", float(value)))
    wait_for(lambda: not engine.status().refolding and engine.status().tuning.get("Q.rate") == pytest.approx(0.1))
    assert_same(pull_all(engine).track, reference(times, values, "kf", Tuning.of(MODEL).set("Q.rate", 0.1)))


def test_history_is_bounded_and_a_refold_starts_where_it_was_cut(started):
    n = 30_000
    times, values = series(n)
    source = Scripted()
    engine = started(source, history=8000)
    for start in range(0, n, 500):
        source.put(readings(times[start : start + 500], values[start : start + 500]))
    # The count goes on; the rows are bounded.
    wait_for(lambda: (status := engine.status()).t == round(times[-1] * SECOND) and status.counts["readings"] == n)
    pull = pull_all(engine)
    assert 8000 <= len(pull.events) <= 8000 + 4 * 1024
    expected = reference(times, values)
    windowed = ("nis_mean", "nis_low", "nis_high", "health", "age")
    kept = expected.select(slice(pull.first, n))
    for name, a, b in zip(kept._fields, pull.track, kept, strict=True):
        if name not in windowed:
            np.testing.assert_array_equal(a, b, err_msg=name)
    # A Kalman filter's mean and covariance are all of its state: refolding from the cut changes nothing.
    engine.submit(commands.SetTuning("Q.rate", Tuning.of(MODEL).get("Q.rate")))
    wait_for(lambda: pull_all(engine).revision == 1)
    again = pull_all(engine)
    np.testing.assert_array_equal(again.track.mean, kept.mean)


def test_bad_commands_are_one_line_and_change_nothing(started):
    source = Scripted()
    engine = started(source)
    source.put(readings([1.0], [40]))
    wait_for(lambda: row_count(engine) == 1)
    for command in (
        commands.SetTuning("R.winding", -1.0),
        commands.SetTuning("Q.nothing", 1.0),
        commands.SetEstimator("magic"),
        commands.SetOption("alpha", 5.0),
        commands.Pause(True),
    ):
        engine.submit(command)
    engine.submit(commands.SetTuning("R.winding", 9.0))
    wait_for(lambda: pull_all(engine).revision == 1)
    assert engine.status().tuning.get("R.winding") == 9.0
    errors = [line.text for line in engine.notices.since(0) if line.level == "error"]
    assert errors and all("\n" not in text for text in errors)


def test_reset_goes_back_to_the_prior(started):
    source = Scripted()
    engine = started(source)
    source.put(readings([1.0, 2.0], [50, 51]))
    wait_for(lambda: row_count(engine) == 2)
    engine.submit(commands.Reset())
    wait_for(lambda: row_count(engine) == 3)
    np.testing.assert_array_equal(pull_all(engine).track.mean[-1], [35.0, 0.0])
    np.testing.assert_allclose(pull_all(engine).track.std[-1], [5.0, 1.0], rtol=1e-15)


def test_nan_is_missing_and_the_twin_goes_on(started):
    source = Scripted()
    engine = started(source)
    source.put(readings([1.0, 2.0, 3.0], [40, np.nan, 41]))
    wait_for(lambda: row_count(engine) == 3)
    assert engine.status().counts["missing"] == 1
    assert np.isfinite(pull_all(engine).track.mean).all()
    assert any("no value" in line.text for line in engine.notices.since(0))


def test_a_live_source_that_fails_is_reopened():
    sources = [Scripted(live=True), Scripted(live=True)]
    opened = iter(sources)
    engine = Engine(twin(), lambda report: next(opened))
    engine.start()
    try:
        sources[0].put(readings([1.0], [40]))
        sources[0].put(OSError("bus off"))
        sources[1].put(readings([2.0], [41]))
        wait_for(lambda: row_count(engine) == 2)
        texts = [line.text for line in engine.notices.since(0)]
        assert any("bus off" in text for text in texts)
        assert engine.notices.counts()["source reopened"] == 1
    finally:
        engine.stop()


def test_end_of_source_is_said_and_the_page_stays(started):
    source = Scripted()
    engine = started(source)
    source.put(readings([1.0], [40]))
    source.put(None)
    wait_for(lambda: engine.status().finished)
    engine.submit(commands.SetEstimator("ekf"))
    wait_for(lambda: pull_all(engine).revision == 1)


def test_silence_predicts_and_health_degrades(started):
    source = Scripted(live=True)
    engine = started(source, tick=0.02)
    source.put(readings([1.0], [40]))
    wait_for(lambda: row_count(engine) >= 4)
    track = pull_all(engine).track
    assert np.all(np.diff(track.std[:, 0]) > 0)
    assert isinstance(pull_all(engine).events, Events)


def by_hand(times, values):
    """An engine without threads, that has taken these readings."""
    engine = Engine(twin(), lambda report: Scripted())
    engine._accept([readings(times, values)])
    return engine


def refolded(engine):
    """What the refolder makes of the newest request."""
    ticket, make = engine._refolder._pending
    return engine._refolder._fold(ticket, make)


def test_a_late_reading_between_two_requests_reaches_the_first_ones_answer():
    times, values = series(100)
    engine = by_hand(np.delete(times, 60), np.delete(values, 60))
    engine.retune("kf", engine.tuning.set("Q.rate", 0.1))
    first = refolded(engine)
    engine._accept([readings(times[[60]], values[[60]])])
    engine.retune("kf", engine.tuning.set("Q.rate", 0.2))
    engine._adopt(first)
    assert_same(pull_all(engine).track, reference(times, values, "kf", Tuning.of(MODEL).set("Q.rate", 0.1)))
    assert engine.status().refolding
    engine._adopt(refolded(engine))
    assert_same(pull_all(engine).track, reference(times, values, "kf", Tuning.of(MODEL).set("Q.rate", 0.2)))


def test_a_source_that_begins_again_during_a_refold_gets_no_rows_of_the_old_log():
    times, values = series(300)
    engine = by_hand(times[:200], values[:200])
    engine.retune("ukf", engine.tuning)
    old = refolded(engine)
    engine._restart()
    engine._accept([readings(times[200:], values[200:])])
    engine._adopt(old)
    engine._status = None
    assert_same(pull_all(engine).track, reference(times[200:], values[200:]))
    assert engine.status().estimator == "ukf" and engine.status().refolding, "what was asked for is asked for again"
    engine._adopt(refolded(engine))
    assert_same(pull_all(engine).track, reference(times[200:], values[200:], "ukf"))


def test_a_refold_that_fails_after_a_late_reading_leaves_what_runs():
    times, values = series(100)
    engine = by_hand(times, values)
    engine.retune("kf", engine.tuning.set("Q.rate", 0.1))
    good = refolded(engine)
    engine.retune("enkf", engine.tuning.with_options({"radius": 5.0}))
    bad = refolded(engine)
    engine._adopt(good)
    engine._adopt(bad)
    status = engine.status()
    assert (status.estimator, status.tuning.get("Q.rate"), status.refolding) == ("kf", 0.1, False)
    (text,) = [line.text for line in engine.notices.since(0) if line.level == "error"]
    assert text.startswith("not folded again: ") and "position" in text and "\n" not in text


class Told:
    """A lock that asks, whenever it is taken, whether another thread could have seen what is not so."""

    def __init__(self, lock, honest):
        self.lock, self.honest, self.seen = lock, honest, []

    def acquire(self, timeout=-1):
        self.seen.append(self.honest())
        return self.lock.acquire(timeout=timeout)

    def release(self):
        self.lock.release()
        self.seen.append(self.honest())

    __enter__ = acquire

    def __exit__(self, *_):
        self.release()


@pytest.mark.parametrize(("estimator", "options", "ends"), [("ukf", {}, "ukf"), ("enkf", {"radius": 5.0}, "kf")])
def test_nobody_sees_the_old_rows_and_that_no_refold_is_waited_for(estimator, options, ends):
    """Also of one that fails, after which the estimator is the old one again."""
    engine = by_hand(*series(100))
    lock = Told(engine._lock, lambda: engine._requests.waiting or engine.estimator == engine._fold.estimator.name)
    engine.retune(estimator, engine.tuning.with_options(options))
    done = refolded(engine)
    engine._lock = lock
    engine._adopt(done)
    assert engine._fold.estimator.name == engine.estimator == ends and not engine._requests.waiting
    assert lock.seen == [True, True]


@pytest.mark.parametrize("name", ["pf", "enkf"])
def test_the_same_filter_keeps_its_members_when_a_cut_history_is_folded_again(started, name):
    times, values = series(7000)
    made = twin(history=2048)
    made.estimator = name
    made.tuning = made.tuning.with_options({"particles": 30.0} if name == "pf" else {"members": 8.0})
    source = Scripted()
    engine = Engine(made, lambda report: source)
    engine.start()
    try:
        for start in range(0, 7000, 500):
            source.put(readings(times[start : start + 500], values[start : start + 500]))
        wait_for(lambda: engine.status().counts["readings"] == 7000)
        seen = pull_all(engine)
        assert seen.first > 0
        engine.submit(commands.SetTuning("Q.rate", Tuning.of(MODEL).get("Q.rate")))
        wait_for(lambda: pull_all(engine).revision == 1)
        np.testing.assert_array_equal(pull_all(engine).track.mean, seen.track.mean)
    finally:
        engine.stop()


def test_what_went_wrong_is_counted_by_sensor_however_often_it_is_folded():
    """A late reading and a retuning fold the same rows again; a batch of two is one complaint."""
    made = load_twin("gripper_contact")
    source = Scripted()
    engine = Engine(made, lambda report: source)
    engine.start()
    model = made.model
    force, position = (model.sensor_names.index(name) for name in ("force", "position"))

    def batch(*readings):
        t = np.array([round(second * SECOND) for second, _, _ in readings])
        channel = np.array([sensor for _, sensor, _ in readings], np.int32)
        value = np.full((t.size, model.width), np.nan)
        value[:, 0] = [y for _, _, y in readings]
        return Events(t, t.copy(), np.full(t.size, READING, np.int8), channel, value)

    try:
        source.put(batch((0.01, force, np.nan), (0.02, force, np.nan), (0.03, position, np.nan), (0.04, force, 1e9)))
        source.put(batch((0.05, force, np.nan), (0.06, position, 0.0)))
        wait_for(lambda: row_count(engine) == 6)
        source.put(batch((0.015, position, np.nan)))
        wait_for(lambda: row_count(engine) == 7)
        engine.submit(commands.SetTuning("R.position", 1e-6))
        wait_for(lambda: engine.status().revision > 0 and not engine.status().refolding)
        wait_for(lambda: engine.status().counts["readings"] == 7)
        counts = engine.status().counts
        assert counts["missing"] == 5 and counts["missing force"] == 3 and counts["missing position"] == 2
        assert counts["gated"] == counts["gated force"] == 1 and "gated position" not in counts
    finally:
        engine.stop()


class Solver:
    """The motor's winding behind a solver that can be away."""

    def __init__(self):
        self.away = False

    def f(self, X, u, p, dt):
        if self.away:
            raise RuntimeError("the solver is away")
        return X @ np.array([[1.0, dt], [0.0, 1.0]]).T

    def h(self, X, u, p):
        return X[:, :1]

    def model(self):
        sensors = tuple(replace(sensor, h=self.h, H=None) for sensor in MODEL.sensors)
        return replace(MODEL, f=self.f, F=None, linear=False, sensors=sensors, black_box=True)


def test_a_black_box_that_fails_loses_nothing_and_says_so_once(started):
    """15 readings of which the solver misses 5: those have failed, the others are as if they had not come."""
    solver = Solver()
    box = solver.model()
    source = Scripted()
    engine = started(source, model=box, estimator="filterpy-ukf")
    times, values = series(15)
    for rest, away in ((slice(0, 5), False), (slice(5, 10), True), (slice(10, 15), False)):
        solver.away = away
        for one in range(rest.start, rest.stop):
            source.put(readings(times[one : one + 1], values[one : one + 1]))
            wait_for(lambda upto=one + 1: row_count(engine) == upto)
    pull = pull_all(engine)
    np.testing.assert_array_equal(pull.events.value[:, 0], values)
    assert list(pull.track.verdict) == [USED] * 5 + [FAILED] * 5 + [USED] * 5
    counts = fresh_status(engine).counts
    assert counts["failed"] == 5 and counts["used"] == 10
    assert np.all(pull.track.health[5:10] == DIVERGED) and np.all(np.isnan(pull.track.mean[5:10]))
    kept = np.r_[0:5, 10:15]
    log = Log(box.width)
    log.extend(readings(times[kept], values[kept]))
    expected = fold("filterpy-ukf", box, Tuning.of(box), log)
    np.testing.assert_array_equal(pull.track.mean[kept], expected.mean)
    np.testing.assert_array_equal(pull.track.std[kept], expected.std)
    said = [line.text for line in pull.notices if "solver" in line.text]
    line = Solver.f.__code__.co_firstlineno + 2
    assert len(said) == 1
    assert f"test_engine.py:{line}: model motor_winding: f fails on a block of 5 states: RuntimeError: the" in said[0]
    assert "return NaN in the rows" in said[0] and "count as failed" in said[0]
    assert "engine error" not in engine.status().counts


def test_a_refold_over_a_black_box_that_fails_says_so_too(started):
    solver = Solver()
    source = Scripted()
    engine = started(source, model=solver.model(), estimator="filterpy-ukf")
    times, values = series(5)
    source.put(readings(times, values))
    wait_for(lambda: row_count(engine) == 5)
    solver.away = True
    engine.submit(commands.SetTuning("Q.rate", 0.5))
    wait_for(lambda: pull_all(engine).revision == 1)
    pull = pull_all(engine)
    # The first needs no f: the clock starts with it.
    assert list(pull.track.verdict) == [USED] + [FAILED] * 4
    assert sum("the solver is away" in line.text for line in engine.notices.since(0)) == 1


def test_the_same_failure_is_said_once_however_long_it_lasts():
    """A minute passes between two readings, so that nothing is left out for coming too fast."""
    solver = Solver()
    model = solver.model()
    log = Log(model.width)
    growing = Fold("filterpy-ukf", model, Tuning.of(model), log)
    notices = Notices(lambda: 0, clock=itertools.count(0, 60).__next__)
    watch = Alerts(notices)
    for k, away in enumerate([False, True, True, False, True]):
        solver.away = away
        log.extend(readings([k + 1.0], [40.0]))
        growing.advance()
        watch.look(growing, k)
    texts = [line.text for line in notices.since(0)]
    assert sum("the solver is away" in text for text in texts) == 1
    assert sum("measurement could not be used" in text for text in texts) == 3
    watch.again()
    watch.look(growing, growing.n)
    assert sum("the solver is away" in line.text for line in notices.since(0)) == 2


def cooling(x, u, p, q, dt, out):
    """A variance below 50 °C only."""
    out[0, 0] = q[0] * dt * (50.0 - x[0])
    out[1, 1] = q[1] * dt


@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
def test_a_noise_that_is_none_where_the_asset_gets_is_named_once_a_fold(started, estimator):
    source = Scripted()
    engine = started(source, model=replace(MODEL, Q=cooling, linear=False), estimator=estimator)
    times = np.arange(1.0, 61.0)
    source.put(readings(times, 40.0 + times))
    wait_for(lambda: row_count(engine) == 60)

    def said():
        return [line for line in engine.notices.since(0) if "positive semidefinite" in line.text]

    assert engine.status().counts["failed"] > 0 and engine.status().health == DIVERGED
    (line,) = said()
    place = rf"\S*test_engine.py:{cooling.__code__.co_firstlineno}: model motor_winding: "
    found = re.match(
        place + r"Q\(x, u, dt\) is not positive semidefinite \(it has the eigenvalue -\S+\) at x = \[(\S+), ", line.text
    )
    assert found and float(found[1]) > 50.0 and line.level == "error"
    # When it happened: the asset is at 50 °C after 10 s.
    assert 5 * SECOND < line.t < 60 * SECOND
    source.put(readings([61.0, 62.0], [101.0, 102.0]))
    wait_for(lambda: row_count(engine) == 62)
    assert len(said()) == 1
    engine.submit(commands.SetTuning("R.winding", 5.0))
    wait_for(lambda: pull_all(engine).revision == 1)
    assert len(said()) == 2
    # A fold without trouble has nothing to say.
    engine.submit(commands.SetTuning("Q.temperature", 0.0))
    wait_for(lambda: pull_all(engine).revision == 2)
    assert len(said()) == 2


def test_the_running_filter_chosen_again_keeps_its_options(started):
    """It goes on as it runs, not as it stood before the last option was turned."""
    engine = started(Scripted(live=True), estimator="ukf")
    engine.submit(commands.SetOption("alpha", 0.5))
    engine.submit(commands.SetOption("alpha", 0.25))
    engine.submit(commands.SetEstimator("ukf"))
    engine.submit(commands.SetOption("beta", 1.0))
    wait_for(lambda: engine.status().options["beta"] == 1.0)
    assert engine.status().options["alpha"] == 0.25
    engine.submit(commands.SetEstimator("kf"))
    engine.submit(commands.SetEstimator("ukf"))
    engine.submit(commands.SetOption("kappa", 1.0))
    wait_for(lambda: engine.status().options.get("kappa") == 1.0)
    assert (engine.status().options["alpha"], engine.status().options["beta"]) == (0.25, 1.0)
