"""A twin's file saved in an editor: folded again, refused with its line, or started anew."""

import os
from contextlib import contextmanager
from unittest.mock import Mock

import numpy as np
import pytest

from app.engine.commands import SetEstimator, SetTuning
from app.record.reader import read_recording
from app.twin.changes import merged, obstacle
from app.twin.twin import load_twin
from app.web.gallery.gallery import SavedFiles
from app.web.running import stamp_of
from estimators.model.user_file import imported_beside
from tests.app.scripted import pull_all
from tests.app.web.gallery.opened import opened
from tests.cases import cases
from tests.support import as_log
from tests.waiting import wait_for

YAML = """\
model: motor_winding
noise:
  temperature: {variance: 0.01}
sensors:
  winding: {variance: 4}
estimator: kf
source: {type: simulator, seed: 2, step: 0.1, duration: 20, sensors: {winding: {every: 1}}}
"""


@pytest.fixture
def pump(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "pump.yaml"
    save(path, YAML)
    return path


def save(path, text):
    """As an editor does: at once, under another name first. Its time differs from that of the one before."""
    stamp = path.stat().st_mtime_ns if path.exists() else 0
    other = path.with_suffix(".new")
    other.write_text(text)
    now = max(other.stat().st_mtime_ns, stamp + 10**7)
    os.utime(other, ns=(now, now))
    other.replace(path)


@contextmanager
def ended(pump):
    """The session of a twin whose source has ended, and its engine."""
    with opened(pump.parent / "r", pump, speed=1e6) as session:
        wait_for(lambda: session.engine.status().finished)
        yield session, session.engine


def folded(session):
    wait_for(lambda: not session.engine.status().refolding)


def told(session):
    return session.get("/api/status")


def lines(session):
    return [(line.level, line.text) for line in session.engine.notices.since(0)]


def mean(path, events):
    """What another fold makes of the same readings, with the file as it is."""
    twin = load_twin(path)
    log = as_log(events)
    fold = twin.fold(log, pairs=twin.pairs)
    fold.advance()
    return fold.track.mean


def test_a_saved_tuning_is_a_revision_over_the_same_readings(pump):
    with ended(pump) as (session, engine):
        # What is turned on the page stays, unless the file says otherwise.
        engine.submit(SetTuning("R.winding", 9.0))
        wait_for(lambda: engine.status().revision == 1)
        before = pull_all(engine)
        save(pump, YAML.replace("0.01", "0.5"))
        wait_for(lambda: engine.status().revision == 2)
        folded(session)
        after = pull_all(engine)
        np.testing.assert_array_equal(after.events.value, before.events.value)
        assert session.engine is engine and told(session)["tuning"]["Q.temperature"] == 0.5
        assert told(session)["tuning"]["R.winding"] == 9.0 and told(session)["turned"] == {"R.winding": 4.0}
        save(pump.with_name("both.yaml"), YAML.replace("0.01", "0.5").replace("variance: 4", "variance: 9"))
        np.testing.assert_array_equal(after.track.mean, mean(pump.with_name("both.yaml"), after.events))
        assert "pump.yaml saved: Q.temperature 0.01 → 0.5 °C²/s" in [run["what"] for run in session.get("/api/runs")]
        model = session.get("/api/model")
        assert {item["key"]: item["configured"] for item in model["tuning"]}["Q.temperature"] == 0.5


def test_a_mistake_is_said_with_its_line_and_what_runs_goes_on(pump):
    with opened(pump.parent / "r", pump) as session:
        engine = session.engine
        save(pump, YAML.replace("variance: 4", "variance: -4"))
        wait_for(lambda: told(session)["unread"] is not None)
        assert told(session)["unread"].startswith("pump.yaml:5: ") and "-4" in told(session)["unread"]
        assert ("error", f"not read again: {told(session)['unread']}") in lines(session)
        before = engine.status().counts.get("readings", 0)
        wait_for(lambda: engine.status().counts.get("readings", 0) > before + 2)
        assert engine.status().revision == 0 and told(session)["tuning"]["R.winding"] == 4.0
        save(pump, YAML.replace("variance: 4", "variance: 16"))
        wait_for(lambda: engine.status().revision == 1)
        assert told(session)["unread"] is None and told(session)["tuning"]["R.winding"] == 16.0


def test_another_shape_is_started_anew_and_says_so(pump):
    with opened(pump.parent / "r", pump) as session:
        boot = session.state()["boot"]
        save(pump, YAML.replace("seed: 2", "seed: 3"))
        wait_for(lambda: session.state()["boot"] != boot)
        assert ("warn", "pump.yaml was saved and its `source` changed: the twin was started anew") in lines(session)
        assert session.state()["running"]["name"] == str(pump) and session.engine.status().revision == 0


MODEL = """\
from dataclasses import replace
from estimators import MODELS

FACTOR = 1.0
base = MODELS["motor_winding"]
Pump = replace(base, name="pump", states=tuple(replace(s, mean=FACTOR * s.mean) for s in base.states))
"""


def test_a_saved_model_is_folded_and_its_mistake_has_a_line(pump):
    model = pump.with_name("pump.py")
    save(model, MODEL)
    save(pump, YAML.replace("motor_winding", "./pump.py:Pump"))
    with ended(pump) as (session, engine):
        began = pull_all(engine)
        save(model, MODEL.replace("1.0", "1.0 / 0"))
        wait_for(lambda: told(session)["unread"] is not None)
        assert told(session)["unread"].startswith("pump.py:4: ZeroDivisionError")
        save(model, MODEL.replace("1.0", "2.0"))
        wait_for(lambda: engine.status().revision == 1)
        folded(session)
        after = pull_all(engine)
        # The prior's mean is twice as high, which the first reading has not made up for.
        assert after.track.mean[0, 0] > began.track.mean[0, 0] + 1.0
        np.testing.assert_array_equal(after.track.mean, mean(pump, after.events))
        # A revision of before has the tuning of before, and the model of now.
        engine.submit(SetEstimator("ekf"))
        wait_for(lambda: engine.status().revision == 2)
        assert engine.folded_with()[0].model is engine.model


IMPORTING = MODEL.replace("FACTOR = 1.0", "from lib.numbers import FACTOR")


def test_a_saved_helper_of_the_model_is_folded_too_and_its_mistake_has_a_line(pump):
    """`f` takes its factor from a file of its own: in machine code, which is kept, it is a constant."""
    helper = pump.parent / "lib" / "numbers.py"
    helper.parent.mkdir()
    save(helper, "FACTOR = 1.0\nDAMPING = 1.0\n")
    damped = """
from lib.numbers import DAMPING
def f(x, u, p, dt, out):
    out[0] = x[0] + DAMPING * dt * x[1]
    out[1] = x[1]
Pump = replace(Pump, f=f, F=None, linear=False)
"""
    save(pump.with_name("pump.py"), IMPORTING + damped)
    save(pump, YAML.replace("motor_winding", "./pump.py:Pump").replace("kf", "ekf"))
    with ended(pump) as (session, engine):
        began = pull_all(engine)
        save(helper, "FACTOR = 1.0\nDAMPING = 1.0 +\n")
        wait_for(lambda: told(session)["unread"] is not None)
        assert told(session)["unread"].startswith("lib/numbers.py:2: ")
        save(helper, "FACTOR = 1.0\nDAMPING = 0.0\n")
        wait_for(lambda: engine.status().revision == 1)
        folded(session)
        after = pull_all(engine)
        assert told(session)["unread"] is None
        assert "numbers.py saved" in [run["what"] for run in session.get("/api/runs")][-1]
        # What was said of the rate no longer moves the temperature: of the rate nothing is learnt.
        np.testing.assert_array_equal(after.events.value, began.events.value)
        assert np.abs(after.track.mean[-1] - began.track.mean[-1]).max() > 1e-3
        spread = engine.model.states[1].std ** 2 + 0.001 * (after.events.t[-1] - after.events.t[0]) * 1e-9
        assert began.track.std[-1, 1] ** 2 < 0.5 * spread
        np.testing.assert_array_equal(after.track.mean, mean(pump, after.events))
        assert after.track.mean[-1, 1] == pytest.approx(engine.model.states[1].mean)


def test_what_a_file_imports_beside_it_is_found_however_it_is_written(tmp_path):
    for name, text in {
        "pump.py": "import math, a\nfrom b import x\nfrom pack.c import y\nfrom pack import d\nimport numpy\n",
        "a.py": "import e\n",
        "e.py": "import a\nimport pump\n",
        "b.py": "x = 1\ndef late():\n    import f\n",
        "f.py": "",
        "other.py": "",
        "pack/__init__.py": "",
        "pack/c.py": "from . import g\nfrom .h import z\n",
        "pack/d.py": "from ..b import x\n",
        "pack/g.py": "not Python",
        "pack/h.py": "z = 1\n",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    found = [str(path.relative_to(tmp_path.resolve())) for path in imported_beside(tmp_path / "pump.py")]
    assert found == ["a.py", "b.py", "e.py", "f.py", *(f"pack/{name}.py" for name in ("__init__", "c", "d", "g", "h"))]


def test_a_recording_has_the_twin_as_it_was_saved_last(pump):
    with ended(pump) as (session, engine):
        session.post("/api/command", {"command": "Record", "path": "run.rrd"})
        wait_for(lambda: engine.status().recording is not None)
        save(pump, YAML.replace("0.01", "0.5"))
        wait_for(lambda: engine.status().revision == 1)
        session.post("/api/command", {"command": "Record", "path": None})
        wait_for(lambda: session.session.recorder.finished)
    recorded = read_recording(pump.parent / "r" / "run.rrd")
    assert recorded.text == pump.read_text() and recorded.tunings == 2


def test_a_file_is_read_once_it_stays_as_it_is(pump):
    """An editor that writes in pieces is not met half-way; and a comment folds nothing."""
    read = []
    running = Mock()
    running.opening.files, running.opening.stamp = (pump,), stamp_of((pump,))
    running.opening.again = lambda: read.append(pump.read_text()) or load_twin(pump)
    running.engine.twin = load_twin(pump)
    files = SavedFiles(Mock(starting=None), running)
    files.check()
    save(pump, YAML + "#")
    files.check()
    assert not read  # it may be written on
    save(pump, YAML + "# a comment\n")
    files.check()
    assert not read
    files.check()
    assert read == [YAML + "# a comment\n"] and not running.engine.reload.called and running.server.unread is None
    save(pump, YAML.replace("0.01", "0.02"))
    for _ in range(3):
        files.check()
    assert len(read) == 2 and [call.args[1] for call in running.engine.reload.mock_calls] == ["pump.yaml saved"]


@cases(__file__, "taken_over.csv")
def test_what_a_running_fold_can_take_over(pump, old, new, says):
    before = load_twin(pump)
    save(pump, YAML.replace(old, new) if old else YAML + new)
    assert obstacle(before, load_twin(pump)) == (says or None)


def test_another_model_is_another_shape(pump):
    assert obstacle(load_twin(pump), load_twin("lorenz63")) == "its states changed"


def test_the_file_rules_what_it_changed_and_the_page_the_rest(pump):
    before = load_twin(pump)
    save(pump, YAML.replace("0.01", "0.5").replace("kf", "ukf") + "gate: 0.99\n")
    after = load_twin(pump)
    turned = before.tuning.set("R.winding", 9.0).set("use.winding", False).set("Q.temperature", 0.2)
    estimator, tuning = merged(before, after, "ekf", turned)
    assert (estimator, tuning.get("Q.temperature"), tuning.get("R.winding")) == ("ukf", 0.5, 9.0)
    assert tuning.get("use.winding") is False and tuning.gate == 0.99 and tuning.model is after.model
    estimator, tuning = merged(before, before, "ekf", turned)
    assert estimator == "ekf" and tuning.get("Q.temperature") == 0.2
