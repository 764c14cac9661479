"""Protection levels beside the running twin: computed from a copy, published for one revision."""

import numpy as np
import pytest

from app.live.fault_monitors import ProtectionMonitor, reason_against
from app.live.jobs import Job, JobCancelled
from app.live.outputs import EventWindow, event_window
from app.twin.twin import load_twin
from app.web.twin_json import status_json
from estimators.diagnostics.sensitivity import bounds_of, sensitivity
from estimators.fold import Fold
from estimators.log import Log
from tests.app.scripted import MODEL, Stepped, random_walk, readings, twin

FALSE_ALARM = 86400.0


def folded(n, estimator="kf"):
    log = Log(MODEL.width)
    log.extend(readings(*random_walk(n)))
    fold = Fold(estimator, MODEL, twin().tuning, log)
    fold.advance()
    return fold


def monitor(fold, limit=4000):
    return ProtectionMonitor(lambda: event_window(fold, 0, limit), FALSE_ALARM)


def assert_close(found, expected, rtol):
    assert set(found) == set(expected) == set(MODEL.state_names)
    for state, bound in expected.items():
        np.testing.assert_allclose(found[state][1:4], bound[1:4], rtol=rtol)


def test_the_status_shows_the_sensitivity_of_the_same_events():
    stepped = Stepped(600)
    engine = stepped.engine
    before = status_json(engine)
    assert (before["integrity"], before["integrity_age"]) == ({}, None)
    engine._watchers.integrity.look(Job("test"))
    found = stepped.status().integrity
    log = Log(MODEL.width)
    log.extend(readings(*random_walk(600)))
    tuning, name = engine.folded_with()
    computed = sensitivity(name, MODEL, tuning, log, false_alarm=engine.policy.false_alarm_every)
    assert found.reason == "" and found.t == int(log.t[log.n - 1])
    assert_close(found.bounds, bounds_of(MODEL, computed), 1e-12)
    # Of the one sensor's noise of 2 °C.
    (smallest,) = found.smallest
    size = float(computed.faults[0].visible)
    assert (smallest.subject, smallest.size) == ("sensor winding", f"{size:.3g} °C" if np.isfinite(size) else "none")
    assert smallest.share == pytest.approx(size / 2.0)
    after = status_json(engine)
    assert set(after["integrity"]) == set(MODEL.state_names) and after["integrity_age"] == 0.0
    for entry in after["integrity"].values():
        assert set(entry) == {"bound", "two_sigma", "unit", "fault"} and entry["bound"] > entry["two_sigma"] > 0.0


def test_levels_of_one_revision_are_computed_rarely_and_those_of_another_at_once(monkeypatch):
    real, revision, computed = event_window(folded(300), 0, 4000), 0, []

    def take():
        real.events.t[-1] += 1
        return real._replace(revision=revision)

    watch = ProtectionMonitor(take, FALSE_ALARM)
    compute = watch._compute
    monkeypatch.setattr(watch, "_compute", lambda taken, job: (computed.append(taken.revision), compute(taken, job))[1])
    for _ in range(3):
        watch.look(Job("test"))
    assert computed == [0] and watch.of(0) is not None and watch.of(1) is None
    revision = 1
    watch.look(Job("test"))
    assert computed == [0, 1] and watch.of(0) is None and watch.of(1) is not None


def test_a_window_starts_at_a_snapshot_and_is_a_copy():
    fold = folded(3000)
    assert event_window(Fold("kf", MODEL, twin().tuning, Log(MODEL.width)), 0, 1000) is None
    taken = event_window(fold, 7, 1000)
    assert taken.revision == 7 and 1000 <= len(taken.events) <= 1063
    assert taken.first + len(taken.events) == 3000
    taken.events.value[:] = 0.0
    assert fold.log.value[2999, 0] != 0.0


def test_a_part_of_the_log_continues_from_the_snapshot_before_it():
    fold = folded(3000)
    watch = monitor(fold, 200)
    watch.look(Job("test"))
    whole = sensitivity("kf", MODEL, fold.tuning, fold.log, most=200, false_alarm=FALSE_ALARM)
    assert_close(watch.of(0).bounds, bounds_of(MODEL, whole), 1e-9)


def test_nothing_is_computed_twice_nor_without_events():
    watch = monitor(folded(300))
    watch.look(Job("test"))
    first = watch.of(0)
    watch._due = 0.0
    watch.look(Job("test"))
    assert watch.of(0) is first
    empty = ProtectionMonitor(lambda: None, FALSE_ALARM)
    empty.look(Job("test"))
    assert empty.of(0) is None


def test_particle_filters_have_a_reason_instead():
    watch = monitor(folded(300, "pf"))
    watch.look(Job("test"))
    assert watch.of(0).bounds == {} and watch.of(0).reason.startswith("pf draws at random")
    assert reason_against(MODEL, "kf") == ""


def test_large_fields_and_failures_have_a_reason_instead():
    field = load_twin("thermal_field").model
    log = Log.of(field)
    log.add("thermocouples", 1.0, np.zeros((1, field.ny)))
    taken = EventWindow("ekf", twin().tuning, log.events, folded(1).track, None, 0)
    watch = ProtectionMonitor(lambda: taken, FALSE_ALARM)
    watch.look(Job("test"))
    assert watch.of(0).bounds == {} and watch.of(0).reason


def test_a_cancelled_job_publishes_nothing():
    watch, job = monitor(folded(300)), Job("test")
    job.cancel()
    with pytest.raises(JobCancelled):
        watch.look(job)
    assert watch.of(0) is None
