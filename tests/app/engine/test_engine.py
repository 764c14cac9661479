"""The engine: for any order, batches, retunes and failures, the track is the fold of the log.

Most tests drive an engine without threads (`Stepped`); those with `started` need the real ones.
"""

import itertools
import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.engine import commands
from app.engine.batches import BatchSizer
from app.engine.engine import Engine
from app.engine.failure_notices import Alerts
from app.engine.feeder import SourceBatch
from app.engine.jobs import Job
from app.engine.notices import Notices
from app.engine.status import busy_status
from app.twin.twin import load_twin
from estimators.fold import Fold, fold
from estimators.log import READING, Events, Log
from estimators.track import DEGRADED, DIVERGED, FAILED, STALE, USABLE, USED
from estimators.tuning import Tuning
from tests.app.scripted import MODEL, Replayed, Scripted, Stepped, pull_all, readings, row_count, solved_by, twin
from tests.support import SECOND, as_log, assert_same
from tests.waiting import wait_for

FIRST = Tuning.of(MODEL)


@pytest.fixture
def started():
    """An engine with its threads."""
    engines = []

    def start(*sources, **options):
        opened = iter(sources)
        engine = Engine(twin(**options), lambda report: next(opened))
        engines.append(engine)
        engine.start()
        return engine

    yield start
    for engine in engines:
        engine.stop()


def series(n, seed=1):
    rng = np.random.default_rng(seed)
    return np.arange(1, n + 1) * 0.01, 40 + np.cumsum(rng.normal(size=n)) * 0.1 + rng.normal(size=n)


def reference(times, values, estimator="kf", tuning=FIRST):
    return fold(estimator, MODEL, tuning, as_log(readings(times, values)), pairs=np.array([[0, 1]]))


def errors(stepped):
    return [line.text for line in stepped.engine.notices.since(0) if line.level == "error"]


def late_order(rng, times, share=0.02):
    """An order of arrival in which some measurements come 0.3 s late, within the horizon of 2 s."""
    late = rng.random(times.size) < share
    return np.argsort(np.where(late, times + 0.3, times), kind="stable")


def batches(rng, order, limit=60):
    cuts = np.cumsum(rng.integers(1, limit, order.size))
    return np.split(order, cuts[cuts < order.size])


EDITS = (
    commands.SetTuning("Q.rate", 0.1), commands.SetTuning("R.winding", 3.0), commands.SetEstimator("ukf"),
    commands.UseSensor("winding", False), commands.Restore(),
)  # fmt: skip


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.0, 0.3), edits=st.lists(st.sampled_from(EDITS), max_size=4))
def test_any_order_and_batches_with_refolds_in_between_equal_one_fold(seed, share, edits):
    """Late measurements rewind the fold, a cursor is taken back by them, and refolds catch up with the log."""
    times, values = series(400)
    rng, stepped = np.random.default_rng(seed), Stepped()
    engine = stepped.engine
    cursor, rows = engine.cursor(), {}
    left, parts = list(edits), batches(rng, late_order(rng, times, share))

    def take():
        pull = engine.pull(cursor)
        if pull.fresh:
            rows.clear()
        rows.update(zip(range(pull.first, pull.first + len(pull.events)), pull.track.mean[:, 0], strict=True))

    for batch in parts:
        stepped.put(readings(times[batch], values[batch]))
        if left and rng.random() < 0.5:
            engine.submit(left.pop())
            # What arrives before the refold is adopted is in it.
            engine._round(0.0)
        take()
    stepped.submit(*left)
    tuning, estimator = engine.folded_with()
    expected = reference(times, values, estimator, tuning)
    assert_same(pull_all(engine).track, expected)
    take()
    np.testing.assert_array_equal([rows[k] for k in range(400)], expected.mean[:, 0])


def test_a_late_measurement_takes_a_cursor_back():
    stepped = Stepped()
    cursor = stepped.engine.cursor()
    stepped.put(readings([1.0, 2.0, 3.0], [40, 41, 42]))
    assert stepped.engine.pull(cursor).first == 0
    stepped.put(readings([2.5], [41.5]))
    again = stepped.engine.pull(cursor)
    assert (again.fresh, again.first) == (False, 2)
    np.testing.assert_array_equal(again.events.t, np.array([2.5, 3.0]) * SECOND)


def test_a_cursor_with_a_span_begins_near_the_end():
    """Also of the next revision; it gets all rows that come or are rewritten later."""
    stepped = Stepped().put(readings(np.arange(1.0, 101.0), np.full(100, 40.0)))
    cursor = stepped.engine.cursor(span=10 * SECOND)
    for revision in (0, 1):
        pull = stepped.engine.pull(cursor)
        assert (pull.fresh, pull.revision, pull.first, len(pull.events)) == (True, revision, 89, 11)
        np.testing.assert_array_equal(pull.events.t, np.arange(90, 101) * SECOND)
        if not revision:
            stepped.submit(commands.SetTuning("R.winding", 9.0))
    stepped.put(readings([99.5], [40.0]))
    late = stepped.engine.pull(cursor)
    assert (late.fresh, late.first, len(late.events)) == (False, 99, 2)


def test_measurements_beyond_the_horizon_are_counted_and_dropped():
    stepped = Stepped().put(readings([10.0, 7.9, 7.5, 8.1], [40, 41, 43, 42]))
    assert stepped.engine.notices.counts()["stale"] == 2
    np.testing.assert_array_equal(pull_all(stepped.engine).events.t, np.array([8.1, 10.0]) * SECOND)
    for times in ([*(t - late for t in range(11, 61) for late in (0, 3)), 61], range(62, 1100)):
        stepped.put(readings(times, [40.0] * len(times)))
        stepped.engine._watchers.episode_log.update()
    episode = next(item for item in stepped.engine.episodes() if item.cause == "dropped")
    assert (episode.start, episode.end, episode.size) == (61 * SECOND * 1e-9, 1099 * SECOND * 1e-9, 52 / 105)


@pytest.mark.parametrize(("step", "std", "told"), [(0.0, 2.0, 1), (0.5, 2.0, 1), (2.0, 2.0, 0), (2.0, 0.6, 0)])
def test_a_source_that_begins_to_hold_its_values_is_an_episode(step, std, told):
    """Ten measurements a second; from 60 s to 120 s each tenth is repeated; values as coarse as the noise hide that."""
    t, y = 0.1 * np.arange(1, 2101), 40.0 + np.random.default_rng(1).normal(0.0, std, 2100)
    y[600:1200] = np.repeat(y[600:1200:10], 10)
    stepped = Stepped(source=Scripted(live=True))
    for rows in np.array_split(np.arange(t.size), 42):
        stepped.put(readings(t[rows], np.round(y[rows] / step) * step if step else y[rows]))
        stepped.engine._watchers.repeats.check(Job("repeats"))
    found = stepped.engine._watchers.repeats.entries
    assert len(found) == told
    for entry in found:
        assert 60.0 < entry.at / SECOND <= 90.0 and 120.0 < entry.episode.end <= 140.0
        assert entry.episode.text.replace("91 %", "90 %") == (  # coarse values may be equal by chance
            "winding repeats its values: new value every 1 s, repeated in 90 % of rows; give its channel in `source` "
            "the key repeats: every 1 s"
        )


@pytest.mark.parametrize(
    ("command", "estimator", "tuned"),
    [
        (commands.SetEstimator("ukf"), "ukf", FIRST),
        (commands.SetTuning("Q.rate", 0.1), "kf", FIRST.set("Q.rate", 0.1)),
        (commands.UseSensor("winding", False), "kf", FIRST.set("use.winding", False)),
    ],
)
def test_a_refold_replaces_the_whole_history(command, estimator, tuned):
    times, values = series(2000)
    stepped = Stepped().put(readings(times, values))
    before, cursor = pull_all(stepped.engine), stepped.engine.cursor()
    stepped.engine.pull(cursor)
    stepped.submit(command)
    pull = stepped.engine.pull(cursor)
    assert (pull.fresh, pull.first, pull.revision) == (True, 0, 1)
    assert_same(pull.track, reference(times, values, estimator, tuned))
    assert_same(stepped.engine.revisions.previous().track, before.track)


def test_with_threads_measurements_that_come_during_a_refold_are_not_lost(started):
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
    assert_same(pull_all(engine).track, reference(times, values, "kf", FIRST.set("Q.rate", 0.01)))


def test_of_many_slider_values_the_last_one_holds():
    times, values = series(500)
    stepped = Stepped().put(readings(times, values))
    stepped.submit(*(commands.SetTuning("Q.rate", float(value)) for value in np.geomspace(1e-4, 1e-1, 50)))
    status = stepped.status()
    assert not status.refolding and status.tuning.get("Q.rate") == pytest.approx(0.1)
    assert status.revision == 1, "the requests in between are not folded"
    assert_same(pull_all(stepped.engine).track, reference(times, values, "kf", status.tuning))


@pytest.mark.parametrize(("name", "options"), [("kf", {}), ("pf", {"particles": 30.0}), ("enkf", {"members": 8.0})])
def test_history_is_bounded_and_a_refold_starts_where_it_was_cut(name, options):
    n = 7000
    times, values = series(n)
    made = twin(history=2048, estimator=name)
    made.tuning = made.tuning.with_options(options)
    stepped = Stepped(of=made).put(*(readings(times[k : k + 500], values[k : k + 500]) for k in range(0, n, 500)))
    # The count goes on; the rows are bounded.
    status, pull = stepped.status(), pull_all(stepped.engine)
    assert status.t == round(times[-1] * SECOND) and status.counts["readings"] == n
    assert 2048 <= len(pull.events) <= 2048 + 4 * 1024
    if name == "kf":
        expected = reference(times, values)
        windowed = ("nis_mean", "nis_low", "nis_high", "health", "age")
        kept = expected.select(slice(pull.first, n))
        for column, a, b in zip(kept._fields, pull.track, kept, strict=True):
            if column not in windowed:
                np.testing.assert_array_equal(a, b, err_msg=column)
    # The base holds all of the filter's state, members and particles too: refolding from the cut changes nothing.
    stepped.submit(commands.SetTuning("Q.rate", FIRST.get("Q.rate")))
    again = pull_all(stepped.engine)
    assert again.revision == 1
    np.testing.assert_array_equal(again.track.mean, pull.track.mean)


def test_bad_commands_are_one_line_and_change_nothing(started):
    engine = started(Scripted())
    for command in (
        commands.SetTuning("R.winding", -1.0),
        commands.SetTuning("Q.nothing", 1.0),
        commands.SetEstimator("magic"),
        commands.SetOption("alpha", 5.0),
        commands.Pause(True),
        commands.SetTuning("R.winding", 9.0),
    ):
        engine.submit(command)
    wait_for(lambda: pull_all(engine).revision == 1)
    texts = [line.text for line in engine.notices.since(0) if line.level == "error"]
    assert engine.tuning.get("R.winding") == 9.0 and texts and all("\n" not in text for text in texts)


def test_a_live_source_that_fails_is_reopened_and_one_that_cannot_be_closed_is_a_notice(started):
    sources = [Scripted(live=True), Scripted(live=True)]
    sources[1].close = lambda: 1 / 0
    engine = started(*sources)
    sources[0].put(readings([1.0], [40]))
    sources[0].put(OSError("bus off"))
    sources[1].put(readings([2.0], [41]))
    wait_for(lambda: row_count(engine) == 2)
    assert any("bus off" in line.text for line in engine.notices.since(0))
    assert engine.notices.counts()["source reopened"] == 1
    engine.stop()
    assert "cannot be closed: ZeroDivisionError: division by zero" in engine.notices.latest("source not closed", 9.0)


def test_after_the_end_of_the_source_the_estimate_can_still_be_retuned():
    stepped = Stepped(1)
    stepped.engine._finish()
    stepped.submit(commands.SetEstimator("ekf"))
    assert stepped.status().finished and pull_all(stepped.engine).revision == 1


def test_a_fold_at_work_has_not_ended_before_its_last_rows_are_told():
    stepped = Stepped(3)
    engine, before = stepped.engine, stepped.status()
    engine.settle()
    with engine._moving():  # by this thread, so that a status cannot read the fold
        engine._finished = True
        with ThreadPoolExecutor(1) as pool:
            told = pool.submit(stepped.status).result()
    assert (told.t, told.finished) == (before.t, False)
    assert stepped.status().finished


def test_a_status_does_not_replace_a_newer_one(monkeypatch):
    engine = Stepped(3).engine
    engine._status = (-np.inf, engine.status())
    entered, leave = threading.Semaphore(0), [threading.Event(), threading.Event()]
    waits = iter(leave)

    def slow(compute):
        def computed(*given):
            status = compute(*given)
            entered.release()
            assert next(waits).wait(10.0)
            return status

        return computed

    monkeypatch.setattr(engine, "_status_now", slow(engine._status_now))
    monkeypatch.setattr("app.engine.engine.busy_status", slow(busy_status))
    with ThreadPoolExecutor(2) as pool:
        older = pool.submit(engine.status)
        assert entered.acquire(timeout=10.0)
        engine.recorder = SimpleNamespace(path="new.rrd")
        newer = pool.submit(engine.status)
        entered.acquire(timeout=0.3)  # before: both compute at once
        leave[0].set()
        assert older.result().recording is None
        leave[1].set()
        assert newer.result().recording == "new.rrd"
    assert engine.status().recording == "new.rrd"


def test_without_measurements_a_live_twin_predicts(started):
    source = Scripted(live=True)
    engine = started(source, tick=0.02)
    source.put(readings([1.0], [40]))
    wait_for(lambda: row_count(engine) >= 4)
    assert np.all(np.diff(pull_all(engine).track.std[:, 0]) > 0)


def refolded(engine):
    """The refold of the newest request, which is not adopted yet."""
    assert engine._refolds.step()
    return engine._inbox.get()


def test_a_late_measurement_between_two_requests_reaches_the_answer_of_the_first():
    times, values = series(100)
    engine = Stepped().engine
    engine._accept([readings(np.delete(times, 60), np.delete(values, 60))])
    engine.retune("kf", engine.tuning.set("Q.rate", 0.1))
    first = refolded(engine)
    engine._accept([readings(times[[60]], values[[60]])])
    engine.retune("kf", engine.tuning.set("Q.rate", 0.2))
    first()
    assert_same(pull_all(engine).track, reference(times, values, "kf", FIRST.set("Q.rate", 0.1)))
    assert engine.status().refolding
    refolded(engine)()
    assert_same(pull_all(engine).track, reference(times, values, "kf", FIRST.set("Q.rate", 0.2)))


@pytest.mark.parametrize(("gesture", "rows", "revision"), [("", 1, 1), ("drag", 100, 2)])
def test_a_newer_edit_ends_an_earlier_refold_unless_both_are_one_drag(gesture, rows, revision, monkeypatch):
    engine, folds = Stepped(100).engine, []

    def advance(sizer, fold):
        if fold not in folds:
            folds.append(fold)
            if len(folds) == 1:
                engine.submit(commands.SetTuning("Q.rate", 0.2, gesture))
                engine._round(0.0)
        return fold.advance(1)

    engine.edit("kf", FIRST.set("Q.rate", 0.1), gesture)
    monkeypatch.setattr(BatchSizer, "advance", advance)
    engine.settle()
    assert [fold.n for fold in folds] == [rows, 100]
    assert engine.folded_with()[0].get("Q.rate") == 0.2 and pull_all(engine).revision == revision


@pytest.mark.parametrize("newer", [False, True])
def test_a_refold_that_catches_up_for_long_or_while_an_edit_waits_gives_way(newer, monkeypatch):
    times, values = series(400)
    engine = Stepped().engine
    engine._accept([readings(times[:100], values[:100])])
    engine.retune("kf", FIRST.set("Q.rate", 0.1))
    first = refolded(engine)
    engine._accept([readings(np.delete(times[100:], 200), np.delete(values[100:], 200))])
    if newer:
        engine.submit(commands.SetTuning("Q.rate", 0.2))
    else:
        monkeypatch.setattr("app.engine.engine.CATCH_UP_S", -1.0)
    first()
    assert engine.status().refolding and pull_all(engine).revision == 0
    engine._accept([readings(times[[300]], values[[300]])])
    engine.settle()
    assert_same(pull_all(engine).track, reference(times, values, "kf", FIRST.set("Q.rate", 0.2 if newer else 0.1)))
    assert pull_all(engine).revision == 1 and not engine._requests.waiting


def test_measurements_that_wait_to_be_folded_are_age_and_health():
    stepped = Stepped(100, source=Scripted(live=True))
    engine, ticks = stepped.engine, stepped.engine._idle_ticks
    assert stepped.status().health in USABLE
    for age, health in ((6.0, DEGRADED), (31.0, STALE)):
        ticks.since = time.monotonic() - age
        engine._inbox.put(SourceBatch(readings([11.0], [40.0]), 0))
        for status in (stepped.status(), engine.latest()):
            assert status.health == health and status.cause.startswith("the filter is behind: measurements of the last")
    engine.settle()
    assert stepped.status().health in USABLE and time.monotonic() - ticks.since < 31.0
    # One that arrived a while ago does not make the estimate younger than it is.
    ticks.since, ticks._begun, events = ticks.since - 100.0, 0, readings([12.0], [40.0])
    events.arrival[:] = time.time_ns() - 50 * SECOND
    engine._accept([events])
    assert time.monotonic() - ticks.since >= 50.0


def test_a_source_that_begins_again_during_a_refold_gets_no_rows_of_the_old_log():
    times, values = series(300)
    stepped = Stepped(source=Replayed()).put(readings(times[:200], values[:200]))
    stepped.engine.submit(commands.SetEstimator("ukf"))
    stepped.engine._round(0.0)
    stepped.source.restart()
    stepped.put(readings(times[200:], values[200:]))
    status = stepped.status()
    assert (status.estimator, status.refolding) == ("ukf", False), "the refold is requested again"
    assert_same(pull_all(stepped.engine).track, reference(times[200:], values[200:], "ukf"))


def test_a_refold_that_fails_leaves_the_running_fold():
    times, values = series(100)
    stepped = Stepped().put(readings(times, values))
    stepped.submit(commands.SetTuning("Q.rate", 0.1))
    engine = stepped.engine
    engine.retune("enkf", engine.tuning.with_options({"radius": 5.0}))
    engine.settle()
    status = stepped.status()
    assert (status.estimator, status.tuning.get("Q.rate"), status.refolding) == ("kf", 0.1, False)
    (text,) = errors(stepped)
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
def test_nobody_sees_the_old_rows_without_a_refold_that_is_waited_for(estimator, options, ends):
    """Also of a refold that fails, after which the estimator is the old one again."""
    stepped = Stepped().put(readings(*series(100)))
    engine = stepped.engine
    lock = Told(engine._lock, lambda: engine._requests.waiting or engine.estimator == engine._fold.estimator.name)
    engine.retune(estimator, engine.tuning.with_options(options))
    done = refolded(engine)
    engine._lock = lock
    done()
    assert engine._fold.estimator.name == engine.estimator == ends and not engine._requests.waiting
    assert lock.seen == [True, True]


def test_failures_are_counted_by_sensor_once_however_often_they_are_folded():
    """A late measurement and a retuning fold the same rows again; a batch of two is one notice."""
    made = load_twin("gripper_contact")
    stepped, model = Stepped(of=made), made.model
    force, position = (model.sensor_names.index(name) for name in ("force", "position"))

    def batch(*readings):
        t = np.array([round(second * SECOND) for second, _, _ in readings])
        channel = np.array([sensor for _, sensor, _ in readings])
        value = np.full((t.size, model.width), np.nan)
        value[:, 0] = [y for _, _, y in readings]
        return Events.alike(READING, t, value, channel)

    stepped.put(batch((0.01, force, np.nan), (0.02, force, 1e9), (0.03, position, np.nan), (0.04, force, np.nan)))
    stepped.put(batch((0.05, force, np.nan), (0.06, position, 0.0)))
    stepped.put(batch((0.015, position, np.nan)))
    stepped.submit(commands.SetTuning("R.position", 1e-6))
    status = stepped.status()
    counts = status.counts
    assert status.revision == 1 and counts["readings"] == 7
    assert counts["missing"] == 5 and counts["missing force"] == 3 and counts["missing position"] == 2
    assert counts["gated"] == counts["gated force"] == 1 and "gated position" not in counts
    assert np.isfinite(pull_all(stepped.engine).track.mean).all()
    assert any("no value" in text for text in stepped.notices())
    assert {line.t for line in stepped.engine.notices.since(0) if "rejected by the gate" in line.text} == {SECOND // 50}


class Solver:
    """The motor's winding behind a solver that can be away."""

    def __init__(self):
        self.away = False

    def called(self, dt):
        if self.away:
            raise RuntimeError("the solver is away")


def test_a_black_box_that_fails_loses_nothing_and_is_reported_once():
    """15 measurements of which the solver misses 5: those have failed, the others are as if they had not come."""
    solver = Solver()
    box = solved_by(solver.called)
    stepped = Stepped(model=box, estimator="filterpy-ukf")
    times, values = series(15)
    for k in range(15):
        solver.away = 5 <= k < 10
        stepped.put(readings(times[k : k + 1], values[k : k + 1]))
    pull, status = pull_all(stepped.engine), stepped.status()
    np.testing.assert_array_equal(pull.events.value[:, 0], values)
    assert list(pull.track.verdict) == [USED] * 5 + [FAILED] * 5 + [USED] * 5
    assert status.counts["failed"] == 5 and status.counts["used"] == 10 and "engine error" not in status.counts
    assert np.all(pull.track.health[5:10] == DIVERGED) and np.all(np.isnan(pull.track.mean[5:10]))
    kept = np.r_[0:5, 10:15]
    log = as_log(readings(times[kept], values[kept]))
    expected = fold("filterpy-ukf", box, Tuning.of(box), log)
    np.testing.assert_array_equal(pull.track.mean[kept], expected.mean)
    np.testing.assert_array_equal(pull.track.std[kept], expected.std)
    (text,) = [text for text in stepped.notices() if "solver" in text]
    line = box.f.__code__.co_firstlineno + 1
    assert f"scripted.py:{line}: model motor_winding: f fails on a block of 5 states: RuntimeError: the" in text
    assert "return NaN in the rows" in text and "count as failed" in text


def test_a_refold_over_a_black_box_that_fails_is_reported_too():
    solver = Solver()
    stepped = Stepped(model=solved_by(solver.called), estimator="filterpy-ukf").put(readings(*series(5)))
    solver.away = True
    stepped.submit(commands.SetTuning("Q.rate", 0.5))
    pull = pull_all(stepped.engine)
    # The first needs no f: the clock starts with it.
    assert pull.revision == 1 and list(pull.track.verdict) == [USED] + [FAILED] * 4
    assert sum("the solver is away" in text for text in stepped.notices()) == 1


def test_the_same_failure_is_said_once_however_long_it_lasts():
    """A minute passes between two readings, so that nothing is left out for coming too fast."""
    solver = Solver()
    model = solved_by(solver.called)
    log = Log(model.width)
    growing = Fold("filterpy-ukf", model, Tuning.of(model), log)
    notices = Notices(lambda: 0, clock=itertools.count(0, 60).__next__)
    watch = Alerts(notices)
    for k, away in enumerate([False, True, True, False, True]):
        solver.away = away
        log.extend(readings([k + 1.0], [40.0]))
        growing.advance()
        watch.report(growing, k)
    texts = [line.text for line in notices.since(0)]
    assert sum("the solver is away" in text for text in texts) == 1
    assert sum("measurement could not be used" in text for text in texts) == 3
    watch.again()
    watch.report(growing, growing.n)
    assert sum("the solver is away" in line.text for line in notices.since(0)) == 2


def cooling(x, u, p, q, dt, out):
    """A variance below 50 °C only."""
    out[0, 0] = q[0] * dt * (50.0 - x[0])
    out[1, 1] = q[1] * dt


@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
def test_a_negative_noise_is_named_once_a_fold(estimator):
    stepped = Stepped(model=replace(MODEL, Q=cooling, linear=False), estimator=estimator)
    times = np.arange(1.0, 61.0)
    stepped.put(readings(times, 40.0 + times))

    def lines():
        return [line for line in stepped.engine.notices.since(0) if "positive semidefinite" in line.text]

    assert stepped.status().counts["failed"] > 0 and stepped.status().health == DIVERGED
    (line,) = lines()
    place = rf"\S*test_engine.py:{cooling.__code__.co_firstlineno}: model motor_winding: "
    found = re.match(
        place + r"Q\(x, u, dt\) is not positive semidefinite \(it has the eigenvalue -\S+\) at x = \[(\S+), ", line.text
    )
    assert found and float(found[1]) > 50.0 and line.level == "error"
    # When it happened: the asset is at 50 °C after 10 s.
    assert 5 * SECOND < line.t < 60 * SECOND
    stepped.put(readings([61.0, 62.0], [101.0, 102.0]))
    assert len(lines()) == 1
    stepped.submit(commands.SetTuning("R.winding", 5.0))
    assert len(lines()) == 2
    # A fold without trouble has nothing to report.
    stepped.submit(commands.SetTuning("Q.temperature", 0.0))
    assert pull_all(stepped.engine).revision == 2 and len(lines()) == 2


def test_a_filter_chosen_again_keeps_its_options():
    """The running one its present ones, another one those that it had last, or those of the YAML."""
    made = twin(estimator="ukf")
    made.options_of = lambda name: {"inflation": 1.5} if name == "ekf" else {}
    stepped = Stepped(of=made)
    stepped.submit(*(commands.SetOption("alpha", value) for value in (0.5, 0.25)), commands.SetEstimator("ukf"))
    stepped.submit(commands.SetOption("beta", 1.0))
    options = stepped.status().options
    assert (options["alpha"], options["beta"]) == (0.25, 1.0)
    stepped.submit(commands.SetEstimator("ekf"))
    assert "alpha" not in stepped.status().options and stepped.status().options["inflation"] == 1.5
    stepped.submit(commands.SetEstimator("ukf"), commands.SetOption("kappa", 1.0))
    options = stepped.status().options
    assert (options["alpha"], options["beta"], options["kappa"]) == (0.25, 1.0, 1.0)
