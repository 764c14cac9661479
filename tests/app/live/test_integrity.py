"""Integrity bounds beside the running twin: computed from a copy, published for one revision, ended with it."""

import threading

import numpy as np
import pytest

from app.live.engine import Engine
from app.live.integrity import IntegrityWatch, Window, reason_against, window
from app.twin.twin import load_twin
from app.web.twin_json import status_json
from estimators.diagnostics.sensitivity import bounds_of, sensitivity
from estimators.fold import Fold
from estimators.log import Log
from tests.app.scripted import MODEL, Scripted, readings, row_count, twin, wait_for

EVERY = 86400.0


def series(n, seed=1):
    rng = np.random.default_rng(seed)
    return np.arange(1, n + 1) * 0.1, 40 + np.cumsum(rng.normal(size=n)) * 0.1 + rng.normal(size=n)


@pytest.fixture
def engine():
    source = Scripted()
    running = Engine(twin(), lambda report: source)
    running.start()
    source.put(readings(*series(600)))
    wait_for(lambda: row_count(running) == 600)
    yield running
    running.stop()


def test_what_is_published_is_the_sensitivity_of_the_same_events(engine):
    assert engine.status().integrity is None
    engine._watchers.integrity.look()
    engine._status = None
    found = engine.status().integrity
    log = Log(MODEL.width)
    log.extend(readings(*series(600)))
    tuning, name = engine.folded_with()
    computed = sensitivity(name, MODEL, tuning, log, false_alarm=engine.policy.false_alarm_every)
    expected = bounds_of(MODEL, computed)
    assert found.reason == "" and found.t == int(log.t[log.n - 1])
    assert set(found.bounds) == set(expected) == set(MODEL.state_names)
    for state, bound in expected.items():
        np.testing.assert_allclose(found.bounds[state][1:4], bound[1:4], rtol=1e-12)
        assert found.bounds[state].bound > found.bounds[state].two_sigma
    # Of the one sensor's noise of 2 °C.
    (smallest,) = found.smallest
    size = float(computed.smallest_visible[0])
    assert (smallest.subject, smallest.size) == ("sensor winding", f"{size:.3g} °C" if np.isfinite(size) else "none")
    assert smallest.share == pytest.approx(size / 2.0)


def test_the_api_shows_it_beside_two_sigma(engine):
    before = status_json(engine)
    assert (before["integrity"], before["integrity_age"]) == ({}, None)
    engine._watchers.integrity.look()
    engine._status = None
    after = status_json(engine)
    assert set(after["integrity"]) == set(MODEL.state_names) and after["integrity_age"] == 0.0
    for entry in after["integrity"].values():
        assert set(entry) == {"bound", "two_sigma", "unit", "fault"} and entry["bound"] > entry["two_sigma"] > 0.0


def test_another_revision_has_none_until_it_is_computed(engine):
    engine._watchers.integrity.look()
    assert engine._watchers.integrity.of(0) is not None
    assert engine._watchers.integrity.of(1) is None


def test_the_thread_publishes_and_stops(engine):
    folds = threading.active_count()
    watch = IntegrityWatch(engine.last_events, EVERY, every=0.01)
    watch.start()
    wait_for(lambda: watch.of(0) is not None)
    watch.stop()
    assert not watch.running
    assert threading.active_count() == folds
    engine.stop()
    assert not engine._watchers.integrity.running


def test_bounds_of_one_revision_are_computed_now_and_then_and_those_of_another_soon(engine, monkeypatch):
    """A look that took a millisecond is followed by another in days; meanwhile events come, then another revision."""
    monkeypatch.setattr("app.live.integrity.SHARE", 1e-9)
    real, revision, taken, computed = engine.last_events(), [0], [], []

    def take():
        taken.append(real._replace(revision=revision[0]))
        taken[-1].events.t[-1] += 1
        return taken[-1]

    watch = IntegrityWatch(take, EVERY, every=0.001)
    compute = watch._compute
    monkeypatch.setattr(watch, "_compute", lambda window: (computed.append(window.revision), compute(window))[1])
    watch.start()
    wait_for(lambda: watch.of(0) is not None)
    seen = len(taken)
    wait_for(lambda: len(taken) > seen + 20)
    assert computed == [0]
    revision[0] = 1
    wait_for(lambda: watch.of(1) is not None)
    watch.stop()
    assert computed == [0, 1]


def test_a_window_starts_at_a_snapshot_and_is_a_copy():
    log = Log(MODEL.width)
    log.extend(readings(*series(3000)))
    fold = Fold("kf", MODEL, twin().tuning, log)
    assert window(fold, 0) is None
    fold.advance()
    taken = window(fold, 7, most=1000)
    assert taken.revision == 7 and 1000 <= len(taken.events) <= 1063
    assert taken.base.first + len(taken.events) == 3000
    taken.events.value[:] = 0.0
    assert log.value[2999, 0] != 0.0


def test_a_part_of_the_log_goes_on_from_what_stood_before_it():
    log = Log(MODEL.width)
    log.extend(readings(*series(3000)))
    tuning = twin().tuning
    fold = Fold("kf", MODEL, tuning, log)
    fold.advance()
    watch = IntegrityWatch(lambda: window(fold, 0, most=200), EVERY)
    watch.look()
    whole = bounds_of(MODEL, sensitivity("kf", MODEL, tuning, log, most=200, false_alarm=EVERY))
    assert watch.of(0).bounds.keys() == whole.keys()
    for state, bound in whole.items():
        np.testing.assert_allclose(watch.of(0).bounds[state][1:4], bound[1:4], rtol=1e-9)


def test_nothing_is_computed_twice_nor_while_a_refold_is_waited_for():
    log = Log(MODEL.width)
    log.extend(readings(*series(300)))
    fold = Fold("kf", MODEL, twin().tuning, log)
    fold.advance()
    watch = IntegrityWatch(lambda: window(fold, 0), EVERY)
    watch.look()
    first = watch.of(0)
    watch.look()
    assert watch.of(0) is first
    asleep = IntegrityWatch(lambda: None, EVERY)
    asleep.look()
    assert asleep.of(0) is None


def test_what_it_is_not_kept_for_is_said_with_the_reason():
    log = Log(MODEL.width)
    log.extend(readings(*series(300)))
    fold = Fold("pf", MODEL, twin().tuning, log)
    fold.advance()
    watch = IntegrityWatch(lambda: window(fold, 0), EVERY)
    watch.look()
    assert watch.of(0).bounds == {} and watch.of(0).reason.startswith("pf draws at random")
    assert reason_against(MODEL, "kf") == ""


def test_large_fields_say_so_and_failures_stop_nothing():
    field = load_twin("thermal_field").model
    log = Log.of(field)
    log.add("thermocouples", 1.0, np.zeros((1, field.ny)))
    fold = Fold("kf", MODEL, twin().tuning, Log(MODEL.width))
    base = fold.base_at(0)[1]
    taken = Window("ekf", twin().tuning, log.events, base, 0)
    watch = IntegrityWatch(lambda: taken, EVERY)
    watch.look()
    assert watch.of(0).bounds == {} and watch.of(0).reason


def test_a_twin_that_ends_is_not_waited_for():
    log = Log(MODEL.width)
    log.extend(readings(*series(300)))
    fold = Fold("kf", MODEL, twin().tuning, log)
    fold.advance()
    watch = IntegrityWatch(lambda: window(fold, 0), EVERY)
    watch.stop()
    watch.look()
    assert watch.of(0) is None
