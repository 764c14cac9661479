"""Time in a running twin: wrong stamps, clocks that are set or drift, a source that says nothing, maintenance."""

import json

import numpy as np
import pytest

from app.ingest import CLOCK_MOVED, Planned
from app.live import commands
from app.live.engine import Engine
from app.live.notices import Notices
from app.live.watchers import HostClock, SilentSource
from app.views.recording.reader import read_recording
from app.views.recording.writer import Recorder
from app.web.commands_json import command_from_json
from app.web.twin_json import status_json
from estimators.errors import ConfigError
from estimators.events.maintenance import model_versions
from estimators.log import MAINTENANCE
from estimators.track import STALE, WAITING
from sources.source import WRONG_TIME
from tests.app.scripted import MODEL, Scripted, fresh_status, pull_all, readings, row_count, twin, wait_for
from tests.support import SECOND


@pytest.fixture
def start():
    engines = []

    def start(made=None, live=True):
        source = Scripted(live=live)
        engine = Engine(made or twin(), lambda report: source)
        engine.recorder = Recorder(engine, lambda stream: lambda pull: None)
        engine.recorder.start()
        engine.start()
        engines.append(engine)
        return source, engine

    yield start
    for engine in engines:
        engine.stop()
        engine.recorder.stop()


T = np.arange(1.0, 301.0)
Y = 40.0 + np.random.default_rng(7).normal(size=T.size)


def arrived(times, values, delay=0.01, at=T):
    """Readings stamped with `times` that arrive `delay` after the true times `at`."""
    return readings(times, values)._replace(arrival=np.round((np.asarray(at) + delay) * SECOND).astype(np.int64))


def test_one_wrong_stamp_does_not_blind_the_twin(start):
    source, engine = start()
    stamped = T.copy()
    stamped[99] += 3600.0
    for part in np.array_split(np.arange(300), 23):
        source.put(arrived(stamped[part], Y[part], at=T[part]))
    wait_for(lambda: row_count(engine) == 299)
    counts = fresh_status(engine).counts
    assert counts[WRONG_TIME] == 1 and "stale" not in counts and "held" not in counts
    (text,) = [line.text for line in engine.notices.since(0) if "rejected" in line.text]
    assert text.startswith("winding: its time, 3700 s, is 3601 s after the newest") and "\n" not in text


def test_a_clock_that_was_set_is_named_and_followed(start):
    source, engine = start()
    source.put(arrived(T + np.where(T > 100, 3600.0, 0.0), Y))
    wait_for(lambda: row_count(engine) == 300)
    np.testing.assert_array_equal(pull_all(engine).events.t, np.round(T * SECOND).astype(np.int64))
    assert fresh_status(engine).counts[CLOCK_MOVED] == 1
    (text,) = [line.text for line in engine.notices.since(0) if "clock was set" in line.text]
    assert text.startswith("winding: its clock was set 3600 s ahead at 3701 s")


def test_what_waits_for_the_next_is_counted(start):
    source, engine = start()
    source.put(arrived([*T, 5000.0], [*Y, 40.0], at=[*T, 301.0]))
    wait_for(lambda: row_count(engine) == 300)
    wait_for(lambda: fresh_status(engine).counts.get("held") == 1)
    source.put(None)
    wait_for(lambda: fresh_status(engine).counts.get(WRONG_TIME) == 1)
    assert "held" not in fresh_status(engine).counts


def test_offset_and_drift_are_in_status_page_and_events(start):
    source, engine = start()
    assert status_json(engine)["clock"] is None
    t = np.arange(0.0, 120.0, 0.1)
    delay = np.random.default_rng(1).exponential(0.002, t.size)
    # A clock 20 s behind that loses 500 ppm.
    batch = arrived(t * (1 - 500e-6) - 20.0, np.full(t.size, 40.0), delay, at=t)
    source.put(batch)
    wait_for(lambda: status_json(engine)["clock"] is not None)
    clock = json.loads(json.dumps(status_json(engine)))["clock"]
    # The last line is drawn at most 2 s before the end, during which 1 ms is lost.
    assert clock["offset"] == pytest.approx(-20.06, abs=0.002)
    assert abs(clock["drift_ppm"] + 500.0) < 3 * clock["drift_error_ppm"] < 20.0
    texts = [line.text for line in engine.notices.since(0)]
    assert any("20" in text and "behind this machine's" in text for text in texts)
    assert any("drifts by -50" in text for text in texts)


def test_a_recording_has_no_clock_against_the_host(start):
    source, engine = start(live=False)
    source.put(readings(T, Y))
    wait_for(lambda: row_count(engine) == 300)
    assert status_json(engine)["clock"] is None


def test_a_clock_in_step_is_no_notice():
    notices = Notices(lambda: 0)
    clock = HostClock(notices, 2.0)
    clock.note(arrived(T + 0.5, Y))
    assert clock.estimate.offset == pytest.approx(0.49, abs=0.001) and not notices.since(0)


def test_a_bus_that_is_open_and_silent_waits_and_goes_stale_and_goes_on(start):
    made = twin()
    made.config.time.stale_after = 0.05
    source, engine = start(made)
    wait_for(lambda: fresh_status(engine).health == STALE)
    assert status_json(engine)["health"] == "stale"
    (line,) = [line for line in engine.notices.since(0) if "nothing has come" in line.text]
    assert line.level == "warn" and line.text.startswith("stale: nothing has come since the twin started, 0.05 s ago")
    source.put(arrived(T, Y))
    wait_for(lambda: row_count(engine) == 300)
    assert fresh_status(engine).health not in (WAITING, STALE)
    assert any(line.text.startswith("the source speaks") for line in engine.notices.since(0))


def test_it_waits_until_then():
    now = [100.0]
    notices = Notices(lambda: 0)
    silence = SilentSource(notices, 15.0, lambda: now[0])
    assert silence.health == WAITING
    now[0] = 115.0
    silence.look(live=True)
    assert silence.health == WAITING and not notices.since(0)
    now[0] = 115.1
    silence.look(live=False)
    assert silence.health == WAITING
    silence.look(live=True)
    silence.look(live=True)
    assert silence.health == STALE and len(notices.since(0)) == 1
    silence.broken()
    silence.broken()
    assert len(notices.since(0)) == 2


def test_a_twin_that_has_heard_nothing_waits(start):
    _, engine = start()
    assert status_json(engine)["health"] == "waiting" and status_json(engine)["model_version"] == 1


def test_maintenance_is_an_event_of_the_log_and_of_the_recording(start, tmp_path):
    source, engine = start()
    path = tmp_path / "run.rrd"
    engine.submit(commands.Record(path))
    wait_for(lambda: engine.recorder.path == path)
    source.put(arrived(T[:100], Y[:100], at=T[:100]))
    wait_for(lambda: row_count(engine) == 100)
    body = {"command": "Maintenance", "what": "bearing replaced", "states": ["rate"]}
    engine.submit(command_from_json(body, engine))
    wait_for(lambda: row_count(engine) == 101)
    source.put(arrived(T[100:], Y[100:], at=T[100:]))
    wait_for(lambda: row_count(engine) == 301)
    pull = pull_all(engine)
    assert pull.events.kind[100] == MAINTENANCE and pull.events.t[100] == 100 * SECOND
    np.testing.assert_allclose(pull.track.std[100, 1], MODEL.prior_std[1])
    np.testing.assert_array_equal(pull.track.mean[100], pull.track.mean[99])
    assert fresh_status(engine).model_version == 2
    (line,) = [line for line in engine.notices.since(0) if "bearing" in line.text]
    assert line.text.startswith("maintenance: bearing replaced; rate as uncertain") and line.t == 100 * SECOND
    engine.submit(commands.Record(None))
    wait_for(lambda: path in engine.recorder.finished)
    recorded = read_recording(path)
    np.testing.assert_array_equal(model_versions(recorded.events), model_versions(pull.events))
    assert any("bearing replaced" in text for _, _, text in recorded.notices)


@pytest.mark.parametrize(
    ("what", "states", "text"),
    [
        ("", ["rate"], "describe the change"),
        ("a\nb", ["rate"], "describe the change"),
        ("x" * 201, ["rate"], "in 1 to 200 characters"),
        ("new fan", [], "name the states"),
        ("new fan", ["ratte"], "did you mean rate"),
        ("new fan", ["rate", "rate"], "name each once"),
        ("new fan", "rate", "must be a list of texts"),
    ],
)
def test_maintenance_that_cannot_be_is_refused_with_the_reason(start, what, states, text):
    _, engine = start()
    with pytest.raises(ConfigError, match=text):
        command_from_json({"command": "Maintenance", "what": what, "states": states}, engine)


def test_planned_maintenance_comes_when_its_time_has_come(start):
    made = twin()
    made.maintenance = (Planned(150 * SECOND + 1, "new winding", (0, 1)),)
    source, engine = start(made)
    source.put(arrived(T[:150], Y[:150], at=T[:150]))
    wait_for(lambda: row_count(engine) == 150)
    source.put(arrived(T[150:], Y[150:], at=T[150:]))
    wait_for(lambda: row_count(engine) == 302)
    pull = pull_all(engine)
    assert np.flatnonzero(pull.events.kind == MAINTENANCE).tolist() == [150, 151]
    np.testing.assert_allclose(pull.track.std[151], MODEL.prior_std)
