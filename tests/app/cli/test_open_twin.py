"""How `run` and `review` open a twin: its speed, the gallery, and a review with the verdicts and notes of a run."""

import json
import subprocess
import sys

import numpy as np
import pytest

from app.cli.open_twin import opened_review, opened_twin, recorded_twin
from app.engine.notices import Annotation
from app.record.reader import read_recording
from app.record.writer import write_recording
from app.twin.log_reader import remarking
from app.twin.twin import load_twin
from app.web.session import Session
from config.loader import load
from estimators.diagnostics.episodes import episodes
from estimators.errors import ConfigError, SourceError
from sources.source import LOST_FRAMES, controls_of
from tests import ROOT
from tests.cases import cases
from tests.skips import recorded
from tests.support import SECOND, assert_same, folded
from tests.waiting import wait_for

TWIN = (
    "title: tank\nmodel: motor_winding\nestimator: kf\nsource:\n  type: simulator\n  seed: 1\n  step: 1\n"
    "  duration: 60\n  initial: {temperature: 40}\n"
)


def speed_of(path, **options):
    return controls_of(opened_twin(str(path), **options).open_source(lambda text, level="info": None)).speed


@pytest.mark.parametrize(("view", "times"), [("", 1.0), ("view: {speed: 60}\n", 60.0)])
def test_it_is_that_of_the_twin_or_that_of_the_command_line(tmp_path, view, times):
    path = tmp_path / "tank.yaml"
    path.write_text(TWIN + view)
    assert speed_of(path) == times
    assert speed_of(path, speed=5.0) == 5.0
    assert speed_of(path, speed=np.inf) == np.inf
    assert speed_of(path, overrides={"view.speed": "7"}) == 7.0


@pytest.mark.parametrize("speed", ["0", "-1", ".inf", "fast", "1e12"])
def test_one_that_cannot_be_is_said_with_its_place(tmp_path, speed):
    path = tmp_path / "tank.yaml"
    path.write_text(TWIN + f"view:\n  speed: {speed}\n")
    with pytest.raises(ConfigError, match=r"tank\.yaml:11: view\.speed"):
        load(str(path))


def test_without_a_name_it_is_the_gallery(nisus, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "Nisus shows the gallery at" in nisus("run", "--port", "0", "--no-browser", "--duration", "0.1").out
    assert list(tmp_path.iterdir()) == []  # the folder of recordings is made when there is one


COMMISSIONED = """
model: motor_winding
estimator: kf
noise: {rate: {variance: 1.0e-4}}
sensors: {winding: {std: 1.5}}
source:
  type: simulator
  duration: 120
  seed: 3
  faults: [{kind: bias, sensor: winding, size: 30, start: 60, end: 90}]
baseline:
  winding: {bias: 1.0, scale: 2.0, correlation: 0.3}
"""


def judged(twin, log, base=None):
    how = {"pairs": twin.pairs, "policy": twin.policy, "expected": twin.expected, "base": base}
    fold = folded(twin.estimator, twin.model, log, twin.tuning, **how)
    return fold.track, episodes(fold)


@cases(__file__, "reviewed.csv")
def test_a_review_judges_as_the_run_did(overrides, tmp_path):
    yaml = tmp_path / "motor.yaml"
    yaml.write_text(COMMISSIONED)
    overrides = json.loads(overrides)
    twin, log = recorded(yaml, overrides=overrides)
    track, told = judged(twin, log)
    write_recording(tmp_path / "run.rrd", twin, log, track)
    kept = read_recording(tmp_path / "run.rrd")
    again = recorded_twin(kept)
    assert told
    assert judged(again, log, kept.base)[1] == told
    assert_same(judged(again, log, kept.base)[0], track)
    # And what is compared does depend on what was left out before.
    if overrides or twin.tuning.baseline is not None:
        bare = load_twin(yaml, overrides={"baseline": "{}"} if not overrides else {})
        assert judged(bare, log)[1] != told


def test_the_terminal_states_lost_frames_once(capsys):
    reported = []
    report = remarking(lambda key, text: reported.append(text))
    for share in ("78 %", "79 %"):
        report(LOST_FRAMES, f"{share} of frames dropped by the socket")
    said = capsys.readouterr().err
    assert "78 % of frames dropped" in said and "79 %" not in said
    assert len(reported) == 2


RECORDED = """
import sys
sys.path.insert(0, {root!r})
from pathlib import Path
from app.cli.open_twin import live_source
from app.engine.commands import Annotate, DeleteAnnotation, Record
from app.twin.twin import load_twin
from app.web.running import OpenedTwin
from app.web.session import Session
from tests.waiting import wait_for
twin = load_twin({twin!r})
session = Session(OpenedTwin(twin, live_source(twin, float("inf"))), page=None)
session.engine.submit(Record(Path({path!r})))
session.start()
wait_for(lambda: session.engine.status().finished)
first = session.engine.span()[0] * 1e-9
for text in ("pump off", "a slip", "door open"):
    session.engine.submit(Annotate(text, first + 12.5))
wait_for(lambda: len(session.engine.annotations.notes) == 3)
print("noted", flush=True)
sys.stdin.readline()
session.engine.submit(Annotate("door shut", number=3))
session.engine.submit(DeleteAnnotation(2))
print("corrected", flush=True)
sys.stdin.read()
"""


def test_a_review_has_the_notes_of_a_session_that_was_killed(tmp_path):
    yaml, path = tmp_path / "tank.yaml", tmp_path / "run.rrd"
    yaml.write_text(TWIN)
    code = RECORDED.format(root=str(ROOT), twin=str(yaml), path=str(path))
    child = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline() == "noted\n"
        # Written with the log, which happens some times a second; then only changes are.
        wait_for(lambda: [note.text for note in notes_in(path)] == ["pump off", "a slip", "door open"])
        child.stdin.write("\n")
        child.stdin.flush()
        assert child.stdout.readline() == "corrected\n"
        wait_for(lambda: [note.text for note in notes_in(path)] == ["pump off", "door shut"])
    finally:
        child.kill()
        child.wait()
    session = Session(opened_review(path), page=None)
    assert not read_recording(path).closed
    t = read_recording(path).events.t[0] + round(12.5 * SECOND)
    assert session.engine.annotations.notes == (Annotation(1, t, "pump off"), Annotation(3, t, "door shut"))


def notes_in(path):
    """The notes of a recording that is being written; none while it has no content."""
    try:
        return read_recording(path).annotations
    except SourceError:
        return []
