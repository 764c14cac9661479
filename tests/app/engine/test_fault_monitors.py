"""Faults assessed beside the running twin: protection levels of a revision, and the root cause of an episode."""

import numpy as np
import pytest

from app.engine.copies import EventWindow, event_window
from app.engine.fault_monitors import ProtectionMonitor, RootCause, reason_against
from app.engine.jobs import Job, JobCancelled
from app.engine.notices import Notices
from app.twin.twin import load_twin
from app.web.twin_json import status_json
from estimators.diagnostics.episodes import Episode, episodes
from estimators.diagnostics.sensitivity import bounds_of, sensitivity
from estimators.fold import Fold
from estimators.log import READING, Log
from estimators.models import MODELS
from estimators.tuning import Tuning
from sources.simulator import Simulator, constant_input, stepped_input
from tests.app.scripted import MODEL, Stepped, random_walk, readings, twin
from tests.support import as_log, measured, read_all

FALSE_ALARM = 86400.0
DRIVE = MODELS["motor_drive"]


def folded(n, estimator="kf"):
    log = as_log(readings(*random_walk(n)))
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
    engine._watchers.integrity.update(Job("test"))
    found = stepped.status().integrity
    log = as_log(readings(*random_walk(600)))
    tuning, name = engine.folded_with()
    computed = sensitivity(name, MODEL, tuning, log, false_alarm=engine.policy.false_alarm_every)
    assert found.reason == "" and found.t == int(log.t[log.n - 1])
    assert_close(found.bounds, bounds_of(MODEL, computed), 1e-12)
    lasting = Episode(60.0, None, "winding", "spiky", 5.0, 1.0, 9.0, "%", "winding has spikes")
    several = lasting, lasting._replace(end=70.0), lasting._replace(cause="corrected")  # the last, of a state
    told = [engine._watchers.root_cause.with_fault(episode).text for episode in several]
    # A constant offset of the only sensor is one of the temperature, and none of its rate.
    assert told == ["winding has spikes; not affected: rate", "winding has spikes", "winding has spikes"]
    # The rate is wrong already.
    engine._watchers.root_cause._episodes = lambda: [lasting._replace(subject="rate", cause="impossible")]
    assert engine._watchers.root_cause.with_fault(lasting).text == "winding has spikes"
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
        watch.update(Job("test"))
    assert computed == [0] and watch.of(0) is not None and watch.of(1) is None
    revision = 1
    watch.update(Job("test"))
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
    watch.update(Job("test"))
    whole = sensitivity("kf", MODEL, fold.tuning, fold.log, most=200, false_alarm=FALSE_ALARM)
    assert_close(watch.of(0).bounds, bounds_of(MODEL, whole), 1e-9)


def test_nothing_is_computed_twice_nor_without_events_nor_once_cancelled():
    watch, job = monitor(folded(300)), Job("test")
    job.cancel()
    with pytest.raises(JobCancelled):
        watch.update(job)
    assert watch.of(0) is None
    watch.update(Job("test"))
    first = watch.of(0)
    watch._due = 0.0
    watch.update(Job("test"))
    assert watch.of(0) is first is not None
    empty = ProtectionMonitor(lambda: None, FALSE_ALARM)
    empty.update(Job("test"))
    assert empty.of(0) is None


def test_filters_that_draw_and_large_fields_have_a_reason_instead():
    field = load_twin("thermal_field").model
    log = measured(field, "thermocouples", 1.0, np.zeros((1, field.ny)))
    large = EventWindow("ekf", twin().tuning, log.events, folded(1).track, None, 0)
    for taken, reason in ((event_window(folded(300, "pf"), 0, 4000), "pf draws at random"), (large, "")):
        watch = ProtectionMonitor(lambda taken=taken: taken, FALSE_ALARM)
        watch.update(Job("test"))
        assert watch.of(0).bounds == {} and watch.of(0).reason.startswith(reason) and watch.of(0).reason
    assert reason_against(MODEL, "kf") == ""


@pytest.fixture(scope="module")
def drive():
    """A minute and a half of a motor whose yoke reads 2 °C too high from a minute on."""
    inputs = {
        "i_q": stepped_input((0.0, 20.0), (60.0, 200.0)),
        "speed": constant_input(250.0),
        "coolant": constant_input(40.0),
    }
    log = as_log(read_all(Simulator(DRIVE, seed=2, step=0.1, duration=90.0, inputs=inputs)))
    wrong = (log.events.kind == READING) & (log.events.channel == DRIVE.sensor_names.index("yoke"))
    log.events.value[wrong & (log.events.t >= 60 * 10**9), 0] += 2.0
    fold = Fold("ekf", DRIVE, Tuning.of(DRIVE), log)
    fold.advance()
    return fold


def root_cause_of(fold, known):
    notices = Notices(lambda: 0)
    return RootCause(lambda: known, lambda: event_window(fold, 0, 4000), notices, monitor(fold)), notices


def shifted_yoke(fold):
    (yoke,) = [episode for episode in episodes(fold) if (episode.subject, episode.cause) == ("yoke", "shifted")]
    return yoke


def test_the_sensor_that_is_off_is_named_once_and_in_the_text(drive):
    yoke = shifted_yoke(drive)
    cause, notices = root_cause_of(drive, [yoke])
    cause.update(Job("test"))
    cause.update(Job("test"))
    words = cause.fault_behind(yoke)
    assert words.startswith("sensor yoke +")
    assert cause.with_fault(yoke).text == f"{yoke.text}; most likely fault: {words}"
    lines = [line.text for line in notices.since(0)]
    assert lines == [f"yoke: most likely fault: {words}"]


def test_a_consequence_leads_to_the_sensor_that_is_behind_it(drive):
    """What tooth shows is explained best by yoke: its episode is the one to look at, while it lasts."""
    yoke = shifted_yoke(drive)
    tooth = yoke._replace(subject="tooth", text="tooth reads low")
    known = [yoke, tooth]
    cause, _ = root_cause_of(drive, known)
    assert cause.primary([tooth, yoke]) is tooth  # not yet asked
    cause.update(Job("test"))
    assert cause.primary([tooth, yoke]) is yoke and cause.primary([yoke, tooth]) is yoke
    assert cause.primary([tooth]) is tooth


def test_what_is_over_or_no_riddle_is_left_alone(drive):
    over = Episode(60.0, 70.0, "yoke", "shifted", 1.0, 0.5, 1.5, "σ", "yoke reads high")
    stuck = Episode(60.0, None, "tooth", "stuck", 41.0, np.nan, np.nan, "°C", "tooth is stuck")
    cause, notices = root_cause_of(drive, [over, stuck])
    cause.update(Job("test"))
    assert not notices.since(0) and [cause.with_fault(over), cause.with_fault(stuck)] == [over, stuck]


def test_an_episode_older_than_the_window_is_not_guessed(drive):
    old = Episode(60.0, None, "yoke", "shifted", 1.0, 0.5, 1.5, "σ", "yoke reads high")
    late = event_window(drive, 0, 4000)._replace(base=drive.base_at(0)[1]._replace(clock=70 * 10**9))
    cause = RootCause(lambda: [old], lambda: late, Notices(lambda: 0), monitor(drive))
    cause.update(Job("test"))
    assert cause.fault_behind(old) == ""
