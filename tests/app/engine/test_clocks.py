"""Time in a running twin: wrong stamps, clocks that are set or drift, a source without events, maintenance."""

import json

import numpy as np
import pytest

from app.engine.notices import Notices
from app.engine.watchers import HostClock, SilentSource
from app.twin.ingest import CLOCK_MOVED, Planned
from app.web.commands_json import command_from_json
from app.web.twin_json import status_json
from estimators.errors import ConfigError
from estimators.log import MAINTENANCE
from estimators.track import STALE, WAITING
from sources.source import WRONG_TIME
from tests.app.scripted import MODEL, Scripted, Stepped, pull_all, readings, row_count, twin
from tests.cases import cases
from tests.support import SECOND

T = np.arange(1.0, 301.0)
Y = 40.0 + np.random.default_rng(7).normal(size=T.size)


@pytest.fixture
def live():
    return Stepped(source=Scripted(live=True))


def arrived(times, values, delay=0.01, at=T):
    """Readings stamped with `times` that arrive `delay` after the true times `at`."""
    return readings(times, values)._replace(arrival=np.round((np.asarray(at) + delay) * SECOND).astype(np.int64))


def test_one_wrong_stamp_does_not_blind_the_twin(live):
    stamped = T.copy()
    stamped[99] += 3600.0
    live.put(*(arrived(stamped[part], Y[part], at=T[part]) for part in np.array_split(np.arange(300), 23)))
    counts = live.status().counts
    assert row_count(live.engine) == 299 and counts[WRONG_TIME] == 1 and "stale" not in counts and "held" not in counts
    (text,) = [text for text in live.notices() if "rejected" in text]
    assert text.startswith("winding: its time, 3700 s, is 3601 s after the newest") and "\n" not in text


def test_a_clock_that_was_set_is_named_and_followed(live):
    live.put(arrived(T + np.where(T > 100, 3600.0, 0.0), Y))
    np.testing.assert_array_equal(pull_all(live.engine).events.t, np.round(T * SECOND).astype(np.int64))
    assert live.status().counts[CLOCK_MOVED] == 1
    (text,) = [text for text in live.notices() if "clock was set" in text]
    assert text.startswith("winding: its clock was set 3600 s ahead at 3701 s")


def test_what_waits_for_the_next_is_counted(live):
    live.put(arrived([*T, 5000.0], [*Y, 40.0], at=[*T, 301.0]))
    assert row_count(live.engine) == 300 and live.status().counts["held"] == 1
    live.engine._finish()
    counts = live.status().counts
    assert counts[WRONG_TIME] == 1 and "held" not in counts


def test_offset_and_drift_are_in_status_page_and_events(live):
    assert status_json(live.engine)["clock"] is None
    t = np.arange(0.0, 120.0, 0.1)
    delay = np.random.default_rng(1).exponential(0.002, t.size)
    # A clock 20 s behind that loses 500 ppm.
    live.put(arrived(t * (1 - 500e-6) - 20.0, np.full(t.size, 40.0), delay, at=t))
    live.status()
    clock = json.loads(json.dumps(status_json(live.engine)))["clock"]
    # The last line is drawn at most 2 s before the end, during which 1 ms is lost.
    assert clock["offset"] == pytest.approx(-20.06, abs=0.002)
    assert abs(clock["drift_ppm"] + 500.0) < 3 * clock["drift_error_ppm"] < 20.0
    assert any("20" in text and "behind this machine's" in text for text in live.notices())
    assert any("drifts by -50" in text for text in live.notices())


def test_a_recording_has_no_clock_against_the_host():
    stepped = Stepped().put(readings(T, Y))
    assert stepped.status().clock is None


def test_a_clock_in_step_is_no_notice():
    notices = Notices(lambda: 0)
    clock = HostClock(notices, 2.0)
    clock.note(arrived(T + 0.5, Y))
    assert clock.estimate.offset == pytest.approx(0.49, abs=0.001) and not notices.since(0)


def test_a_live_source_without_events_waits_goes_stale_and_reports_again(live, monkeypatch):
    silence = live.engine._watchers.silence
    assert status_json(live.engine)["health"] == "waiting" and status_json(live.engine)["model_version"] == 1
    begun = silence._since
    monkeypatch.setattr(silence, "_clock", lambda: begun + 30.5)
    live.engine._round(0.0)
    assert live.status().health == STALE and status_json(live.engine)["health"] == "stale"
    (line,) = live.engine.notices.since(0)
    assert line.level == "warn" and line.text.startswith("stale: nothing has come since the twin started, 30 s ago")
    live.put(arrived(T, Y))
    assert live.status().health not in (WAITING, STALE)
    assert live.notices()[1].startswith("the source speaks")


def test_it_waits_until_then():
    now, notices = [100.0], Notices(lambda: 0)
    silence = SilentSource(notices, 15.0, lambda: now[0])
    for now[0], is_live, health in ((115.0, True, WAITING), (115.1, False, WAITING), (115.1, True, STALE)):
        silence.check(live=is_live)
        assert silence.health == health
    silence.check(live=True)
    assert len(notices.since(0)) == 1
    silence.broken()
    silence.broken()
    assert len(notices.since(0)) == 2


def test_maintenance_is_an_event_of_the_log(live):
    live.put(arrived(T[:100], Y[:100], at=T[:100]))
    body = {"command": "Maintenance", "what": "bearing replaced", "states": ["rate"]}
    live.submit(command_from_json(body, live.engine))
    live.put(arrived(T[100:], Y[100:], at=T[100:]))
    pull = pull_all(live.engine)
    assert len(pull.events) == 301 and pull.events.kind[100] == MAINTENANCE and pull.events.t[100] == 100 * SECOND
    np.testing.assert_allclose(pull.track.std[100, 1], MODEL.prior_std[1])
    np.testing.assert_array_equal(pull.track.mean[100], pull.track.mean[99])
    assert live.status().model_version == 2
    (line,) = [line for line in live.engine.notices.since(0) if "bearing" in line.text]
    assert line.text.startswith("maintenance: bearing replaced; rate as uncertain") and line.t == 100 * SECOND


@cases(__file__, "refused_maintenance.csv")
def test_maintenance_that_cannot_be_is_refused_with_the_reason(live, what, states, text):
    with pytest.raises(ConfigError, match=text):
        command_from_json({"command": "Maintenance", "what": what, "states": json.loads(states)}, live.engine)


def test_planned_maintenance_comes_when_its_time_has_come():
    made = twin()
    made.maintenance = (Planned(150 * SECOND + 1, "new winding", (0, 1)),)
    stepped = Stepped(of=made, source=Scripted(live=True)).put(arrived(T[:150], Y[:150], at=T[:150]))
    assert row_count(stepped.engine) == 150
    stepped.put(arrived(T[150:], Y[150:], at=T[150:]))
    pull = pull_all(stepped.engine)
    assert np.flatnonzero(pull.events.kind == MAINTENANCE).tolist() == [150, 151]
    np.testing.assert_allclose(pull.track.std[151], MODEL.prior_std)


def test_the_line_of_a_key_is_the_latest_for_so_many_seconds():
    now = [100.0]
    notices = Notices(lambda: 0, lambda: now[0])
    assert notices.latest("frames lost", 10.0) is None
    notices.report("frames lost", "78 % of frames")
    notices.say("another line")
    now[0] += 10.0
    assert notices.latest("frames lost", 10.0) == "78 % of frames"
    now[0] += 0.1
    assert notices.latest("frames lost", 10.0) is None
