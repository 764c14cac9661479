"""Recordings of long sessions: edits add no copies, parts stand for themselves, nothing is written over or through."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections import namedtuple
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from rerun.chunk import RrdReader

import app.record.rrd_file
import app.record.writer
from app.cli.main import main
from app.engine import commands
from app.engine.engine import Engine
from app.engine.fold_json import tuning_from_json
from app.record.format import FORMAT, RecordingFile
from app.record.reader import ReadRecording, finished, read_recording
from app.record.rrd_file import NEVER, Split, parse_split
from app.record.writer import Recorder, RecordingPart
from app.web.server import command_from_json
from estimators.errors import ConfigError
from estimators.log import Log
from estimators.model.assemble import JointParameter, joint
from estimators.model.instruments import Instrument, with_instruments
from sources.merged import MemorySource
from tests import ROOT
from tests.app.scripted import MODEL, Scripted, Stepped, notice_texts, pull_all, readings, twin
from tests.support import as_log, assert_same, folded, run_python
from tests.waiting import LIMIT_S, wait_for

COUNT = 6000
TIMES = np.arange(1, COUNT + 1) * 0.01
VALUES = 40 + np.random.default_rng(3).normal(size=COUNT)


@pytest.fixture
def start(monkeypatch):
    """start(estimator, ...): an engine with its source and recorder, and the pulls that its charts were given."""
    monkeypatch.setattr(app.record.writer, "LOG_PERIOD_S", 0.01)
    monkeypatch.setattr(app.record.writer, "CHARTS_PERIOD_S", 0.02)
    monkeypatch.setattr(app.record.writer, "EDIT_REST_S", 0.02)
    running = []

    def start(estimator="kf", split=NEVER, **options):
        source, drawn = Scripted(), []
        engine = Engine(twin(estimator=estimator, **options), lambda report: source)
        engine.recorder = Recorder(engine, lambda stream: drawn.append, split)
        engine.start()
        running.append(engine)
        return source, engine, drawn

    yield start
    for engine in running:
        engine.stop()
        engine.recorder.stop()


@pytest.fixture
def path(tmp_path):
    """Where a recording may be."""
    return tmp_path / "run.rrd"


def end_of(engine):
    pull = pull_all(engine)
    return pull.first + len(pull.events)


def recorded_to(engine):
    part = engine.recorder._open
    return part._events.next if part is not None else 0


def feed(source, engine, start, stop, step=200, late=()):
    """Put readings, and let the recorder follow; those that are late come after the piece in which they belong."""
    for begin in range(start, stop, step):
        piece = np.arange(begin, min(stop, begin + step))
        for part in (np.setdiff1d(piece, late), np.intersect1d(piece, late)):
            if part.size:
                source.put(readings(TIMES[part], VALUES[part]))
        wait_for(lambda stop=piece[-1] + 1: end_of(engine) == stop)
        wait_for(lambda stop=piece[-1] + 1: engine.recorder.path is None or recorded_to(engine) >= stop)


def record(engine, path):
    """Begin a recording, and wait for that."""
    engine.submit(commands.Record(path))
    wait_for(lambda: engine.recorder.path == path)


def edit(engine, key, value):
    revision = engine._revision
    engine.submit(commands.SetTuning(key, value))
    wait_for(lambda: engine._revision > revision)


def stop_recording(engine):
    count = len(engine.notices.since(0))
    engine.submit(commands.Record(None))
    wait_for(lambda: any(line.text.startswith("recorded ") for line in engine.notices.since(count)))


def refold(recorded):
    """The recorded readings through the fold, as a review does it."""
    tuning, estimator = tuning_from_json(recorded.tuning, MODEL)
    log = Log(MODEL.width)
    log.first = recorded.first
    log.extend(recorded.events)
    fold = folded(estimator, MODEL, log, tuning, pairs=np.array([[0, 1]]), base=recorded.base)
    return fold.track


def reviewed(recorded):
    """The track of an engine that folds the recorded readings, as a review's does."""
    tuning, estimator = tuning_from_json(recorded.tuning, MODEL)
    made = twin(estimator=estimator)
    made.tuning = tuning
    engine = Engine(made, lambda report: MemorySource(recorded.events), base=recorded.base, horizon=np.inf)
    engine.start()
    try:
        wait_for(lambda: engine.status().finished)
        return pull_all(engine).track
    finally:
        engine.stop()


@pytest.mark.parametrize("estimator", ["sr-ekf", "sr-kf", "sr-ukf"])
def test_a_factor_of_an_older_format_is_replaced_by_its_moments(tmp_path, estimator):
    """The upper factor of the whole covariance, as format 2 has it, in the place of the bordered one."""
    own = with_instruments(MODEL, {"winding": Instrument(offset=(0.0,))})
    model = joint(own, {"winding_offset": JointParameter(0.5, considered=True)})
    log = as_log(readings(TIMES[:400], VALUES[:400]))
    whole = folded(estimator, model, log)
    at, base = whole.base_at(200)
    mean, cov = base.mean, base.cov
    old = np.concatenate([mean, np.linalg.cholesky(cov).T.ravel()])
    state = base.state.copy()
    state[: old.size] = old
    for number, left in ((2, base._replace(state=state)), (FORMAT, base)):
        recorded = ReadRecording(
            tmp_path / "old.rrd", "", "", tmp_path, {}, None, left, "", 1, log.events, [], [], at, 0, True, number
        )
        resumed, remark = recorded.base_for(model)
        assert ("old.rrd: format 2" in remark and estimator in remark) if number == 2 else not remark
        rest = log.copy()
        rest.drop_front(at)
        fold = folded(estimator, model, rest, base=resumed)
        # As the filters equal the equations: to 1e-9 of the largest.
        np.testing.assert_allclose(fold.track.mean, whole.track.mean[at:], rtol=0, atol=1e-9 * np.max(VALUES))
        np.testing.assert_allclose(fold.track.std, whole.track.std[at:], rtol=1e-9)
        assert ReadRecording.base_for(recorded, MODEL)[0] is left


def written(path, entity="/nisus/events"):
    """How many rows of an entity a file holds, those written anew included."""
    with pytest.warns(match="no footer"):
        reader = RrdReader(str(path))
    return sum(chunk.num_rows for chunk in reader.stream() if chunk.entity_path == entity)


def test_edits_add_their_tunings_and_one_drawing_of_the_history(start, path):
    source, engine, drawn = start()
    engine.submit(commands.Record(path))
    feed(source, engine, 0, 2000)
    wait_for(lambda: sum(len(pull.events) for pull in drawn) == 2000)
    for k in range(8):
        edit(engine, "Q.rate", 0.01 + 0.001 * k)
        feed(source, engine, 2000 + 100 * k, 2100 + 100 * k)
    seen = pull_all(engine)
    stop_recording(engine)
    assert written(path) == 2800
    assert sum(len(pull.events) for pull in drawn) == 2 * 2800
    # Before the end the charts went on; at the end came the last revision's, from the first row on.
    again = [k for k, pull in enumerate(drawn) if pull.fresh]
    assert len(again) == 2 and again[0] == 0
    assert drawn[again[1]].first == 0 and sum(len(pull.events) for pull in drawn[again[1] :]) == 2800
    np.testing.assert_array_equal(np.concatenate([pull.track.mean for pull in drawn[again[1] :]]), seen.track.mean)
    recorded = read_recording(path)
    assert recorded.tunings == 9
    assert_same(refold(recorded), seen.track)


@pytest.mark.parametrize("estimator", ["kf", "pf"])
def test_parts_fold_by_themselves_to_the_same_bits(estimator, start, tmp_path):
    """Also where a late reading belongs before the part begins, and after an edit within the last one."""
    source, engine, _ = start(estimator, split=Split(size=50_000))
    path = tmp_path / "run.rrd"
    record(engine, path)
    feed(source, engine, 0, 5400, late=range(150, 5400, 200))
    first = pull_all(engine)
    edit(engine, "Q.rate", 0.013)
    feed(source, engine, 5400, COUNT)
    last = pull_all(engine)
    stop_recording(engine)
    assert not engine.recorder.failure
    parts = engine.recorder.finished
    assert parts[:3] == [path, tmp_path / "run-2.rrd", tmp_path / "run-3.rrd"]
    assert [part for part in parts if not finished(part)] == []
    reached = 0
    for part in parts:
        recorded = read_recording(part)
        assert recorded.first <= reached
        seen = last if tuning_from_json(recorded.tuning, MODEL)[0].get("Q.rate") == 0.013 else first
        begin, end = reached, recorded.first + recorded.rows
        again = refold(recorded).select(slice(begin - recorded.first, None))
        assert_same(again, seen.track.select(slice(begin, end)))
        np.testing.assert_array_equal(recorded.events.t, last.events.t[recorded.first : end])
        reached = end
    assert reached == COUNT and seen is last


def test_every_part_has_the_notes_of_users_so_far(start, tmp_path):
    source, engine, drawn = start(split=Split(size=50_000))
    feed(source, engine, 0, 200)
    engine.submit(commands.Annotate("before the recording"))
    wait_for(lambda: engine.annotations.notes)
    engine.submit(commands.Record(tmp_path / "run.rrd"))
    feed(source, engine, 200, 3000)
    wait_for(lambda: engine.recorder.finished)
    engine.submit(commands.Annotate("in the second part or later"))
    feed(source, engine, 3000, COUNT)
    stop_recording(engine)
    first, *_, last = [[note.text for note in read_recording(part).annotations] for part in engine.recorder.finished]
    assert first == ["before the recording"]
    assert last == ["before the recording", "in the second part or later"]
    # For a viewer of the charts they are events, in their last words.
    assert [line.text for line in drawn[-1].notices] == [
        "note: before the recording",
        "note: in the second part or later",
    ]
    # Once in a file, not with every write of the log.
    assert written(engine.recorder.finished[0], "/nisus/annotations") == 1


def test_an_edit_while_a_part_is_begun_reviews_to_the_same_bits(start, path):
    """Where the part starts was copied from the revision before, which is gone when its rows are written."""
    source, engine, drawn = start(split=Split(size=50_000))

    def draw(stream):
        if len(engine.recorder.finished) == 2:
            edit(engine, "Q.rate", 0.013)
        return drawn.append

    engine.recorder._draw = draw
    record(engine, path)
    feed(source, engine, 0, COUNT)
    last = pull_all(engine)
    stop_recording(engine)
    third = read_recording(engine.recorder.finished[2])
    assert engine._revision == 1 and third.first > 0
    end = third.first + third.rows
    # What health and age at the start look back at is in the part before.
    assert_same(refold(third).select(slice(1000, None)), last.track.select(slice(third.first + 1000, end)))


def test_a_part_has_its_events_before_its_first_chart(tmp_path):
    """The first charts of a process take seconds, in which it may be killed."""
    path, stepped, found = tmp_path / "run.rrd", Stepped(50), []
    part = RecordingPart(stepped.engine, path, lambda stream: found.append(read_recording(path).events))
    part.abandon()
    np.testing.assert_array_equal(found[0].value, pull_all(stepped.engine).events.value)


def test_an_edit_between_a_pull_and_its_tuning_is_written_once(tmp_path, monkeypatch):
    stepped, written = Stepped(50), []
    pull = stepped.engine.pull
    before = stepped.engine.tuning.get("Q.rate")
    monkeypatch.setattr(RecordingFile, "tuning", lambda _, now, *at: written.append((at[-1], now.get("Q.rate"))))

    def pull_then_edit(*request, **named):
        found = pull(*request, **named)
        if found.revision == 0:
            stepped.submit(commands.SetTuning("Q.rate", 0.5))
        return found

    monkeypatch.setattr(stepped.engine, "pull", pull_then_edit)
    part = RecordingPart(stepped.engine, tmp_path / "run.rrd", lambda stream: lambda pull: None)
    part.write()
    part.write()
    assert written == [(0, before), (1, 0.5)]


@pytest.mark.parametrize("estimator", ["kf", "pf"])
def test_a_session_that_forgot_its_oldest_events_reviews_to_the_same_bits(estimator, start, path):
    """The history is folded again from what the forgotten events left, and random numbers go by a row's own index."""
    source, engine, _ = start(estimator, history=2048)
    feed(source, engine, 0, 5400, step=100)
    assert pull_all(engine).first > 0
    record(engine, path)
    feed(source, engine, 5400, 5600)
    stop_recording(engine)
    seen = pull_all(engine)
    recorded = read_recording(path)
    assert recorded.first == seen.first
    # Health and age at the start look back at rows that are forgotten.
    begin = recorded.rows - 1000
    for track in (refold(recorded), reviewed(recorded)):
        assert_same(track.select(slice(begin, None)), seen.track.select(slice(begin, None)))


@pytest.mark.parametrize("estimator", ["kf", "pf"])
def test_an_edit_after_events_were_forgotten_reviews_to_the_same_bits(estimator, start, path):
    source, engine, _ = start(estimator, history=2048)
    engine.submit(commands.Record(path))
    feed(source, engine, 0, 5600, step=100)
    assert pull_all(engine).first > 0
    edit(engine, "Q.rate", 0.013)
    feed(source, engine, 5600, 5700)
    stop_recording(engine)
    seen, recorded = pull_all(engine), read_recording(path)
    assert_same(refold(recorded), seen.track)


@pytest.mark.parametrize("broken_link", [True, False])
def test_a_taken_path_is_refused_by_command_line_and_running_twin(start, tmp_path, monkeypatch, capsys, broken_link):
    _, engine, _ = start()
    taken, target = tmp_path / "run.rrd", tmp_path / "elsewhere.rrd"
    taken.symlink_to(target) if broken_link else taken.write_bytes(b"yesterday")
    engine.submit(commands.Record(taken))
    wait_for(lambda: any("is there already" in text for text in notice_texts(engine)))
    assert engine.recorder.path is None
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="already"):
        command_from_json({"command": "Record", "path": "run.rrd"}, engine)
    assert main(["run", "motor_winding", "--headless", "--record", str(taken)]) == 2
    assert "is there already" in capsys.readouterr().err
    assert not target.exists() and taken.is_symlink() == broken_link
    assert broken_link or taken.read_bytes() == b"yesterday"


Usage = namedtuple("Usage", "total used free")


def test_a_disk_that_fills_is_warned_of_and_the_recording_closed_in_time(start, path, monkeypatch):
    free = 10**12
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(2 * 10**12, 0, free))
    source, engine, _ = start()

    def warnings():
        return [line.text for line in engine.notices.since(0) if line.level != "info" and "winding" not in line.text]

    engine.submit(commands.Record(path))
    feed(source, engine, 0, 1000)
    assert warnings() == []
    free = app.record.rrd_file.RESERVED_BYTES + 500_000_000
    wait_for(lambda: any("has room for 500 MB more" in text for text in notice_texts(engine)))
    assert engine.recorder.path == path
    feed(source, engine, 1000, 1400)
    free = app.record.rrd_file.RESERVED_BYTES - 1
    wait_for(lambda: engine.recorder.failure)
    assert engine.recorder.failure.startswith(f"recording failed: {path}: the disk is nearly full; ")
    assert len(warnings()) == 2 and warnings()[1] == engine.recorder.failure
    recorded = read_recording(path)
    assert recorded.closed and recorded.rows == 1400
    assert_same(refold(recorded), pull_all(engine).track)
    feed(source, engine, 1400, 1500)  # the twin goes on


def test_a_fast_growing_file_is_warned_of_by_its_rate(tmp_path, monkeypatch):
    now, free = 0.0, app.record.rrd_file.RESERVED_BYTES + 9 * 10**9
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(0, 0, free))
    disk = app.record.rrd_file.Disk(tmp_path, clock=lambda: now)
    assert disk.warning(10**9) is None
    now = app.record.rrd_file.GROWTH_SETTLING_S + 40.0
    assert disk.warning(10**9 + 10**9 // 2) is None  # 5 MB/s fill 9 GB in 1800 s
    now = app.record.rrd_file.GROWTH_SETTLING_S + 60.0
    line = disk.warning(10**9 + 12 * 10**8)  # 10 MB/s in 900 s
    assert line is not None and "9000 MB more, enough for about 15 min" in line
    assert disk.warning(10**9 + 13 * 10**8) is None


@pytest.mark.parametrize(
    ("text", "split"),
    [
        ("1GB", Split(size=1e9)),
        ("500 mb", Split(size=5e8)),
        ("10min", Split(seconds=600.0)),
        ("1.5h", Split(seconds=5400.0)),
        ("1GB, day", Split(size=1e9, daily=True)),
    ],
)
def test_a_split_is_a_size_or_a_time(text, split):
    assert parse_split(text) == split


@pytest.mark.parametrize("text", ["", "10", "GB", "-1GB", "1PB", "1kB", "0s", "inf s", "1e3MB", "9" * 400 + "GB"])
def test_what_is_no_split_is_one_line(text, capsys):
    assert main(["run", "motor_winding", "--headless", "--record", "x.rrd", f"--record-split={text}"]) == 2
    said = capsys.readouterr().err
    assert "must be a size of 100kB or more" in said and said.count("\n") == 1


def test_parts_of_a_dated_name_have_their_date_and_the_oldest_are_removed(start, tmp_path, monkeypatch):
    """Another day begins while the twin records; a name that is taken by an earlier process gets a number."""
    clock = SimpleNamespace(now=time.struct_time((2026, 11, 23, 23, 59, 0, 0, 327, 0)))
    for module in (app.record.rrd_file, app.record.writer):
        monkeypatch.setattr(module.time, "localtime", lambda *_: clock.now, raising=True)
    strftime = time.strftime
    monkeypatch.setattr(app.record.rrd_file.time, "strftime", lambda form: strftime(form, clock.now))
    days = tmp_path / "11"
    days.mkdir()
    names = ["run-20261101.rrd", "run-20261123.rrd", "run-20261123-2.rrd", "run-2026112x.rrd", "other-20261101.rrd"]
    for age, name in enumerate(reversed(names)):
        (days / name).write_bytes(bytes(60_000))
        os.utime(days / name, (1e9 + age * 1000.0,) * 2)
    os.utime(days / names[0], (1e8,) * 2)
    source, engine, _ = start(split=parse_split("day", "150kB"))
    engine.submit(commands.Record(tmp_path / "%m" / "run-%Y%m%d.rrd"))
    source.put(readings(TIMES[:100], VALUES[:100]))
    wait_for(lambda: any("removed" in text for text in notice_texts(engine)) and recorded_to(engine) >= 100)
    clock.now = time.struct_time((2026, 11, 24, 0, 0, 0, 1, 328, 0))
    source.put(readings(TIMES[100:200], VALUES[100:200]))
    wait_for(lambda: len(engine.recorder.written) == 2)
    assert [path.name for path in engine.recorder.written] == ["run-20261123-3.rrd", "run-20261124.rrd"]
    engine.recorder.record(None)
    wait_for(lambda: len(engine.recorder.finished) == 2)
    assert read_recording(days / "run-20261123-3.rrd").rows >= 100
    left = {path.name for path in days.iterdir()}
    assert "run-20261101.rrd" not in left and {"run-2026112x.rrd", "other-20261101.rrd"} < left


@pytest.mark.parametrize(("name", "part"), [("run-%D.rrd", "%D"), ("50%.rrd", "%."), ("run-%/a.rrd", "%/")])
def test_a_name_with_another_part_than_a_date_is_one_line(nisus, name, part):
    line = nisus.refuses("run", "motor_winding", "--headless", "--record", name)
    assert f"--record {name}: {part} is no part of a date; use %Y" in line


GROWTH = """
import sys
sys.path.insert(0, {root!r})
import numpy as np
from pathlib import Path
from types import SimpleNamespace
from app.engine.copies import Pull
from app.record.format import RecordingFile
from estimators.log import READING, Events
from estimators.track import Track
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096
twin = SimpleNamespace(name="x", text="", path=Path("x.yaml"), overrides={{}}, version=None)
file = RecordingFile(Path({path!r}), twin, None)
rows, width = 4, 24
track = Track.allocate(rows, 2, 1, width)
for k in range(7000):
    t = np.arange(rows * k, rows * (k + 1))
    events = Events(t, t, np.zeros(rows, np.int8), np.zeros(rows, np.int32), np.random.rand(rows, width))
    file.write(Pull(0, k == 0, rows * k, events, track))
    file.flush()
    if k == 1000:
        before = resident()
print(resident() - before)
file.close()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_does_not_grow_with_what_was_written(tmp_path):
    """6000 writes are those of forty minutes; Rerun's own sink keeps 2 kB of each for the footer."""
    code = GROWTH.format(root=str(ROOT), path=str(tmp_path / "x.rrd"))
    child = run_python(code)
    assert int(child.stdout) < 2_000_000


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP here")
def test_a_terminal_that_closes_leaves_a_whole_recording(path):
    words = ["run", "motor_winding", "--headless", "--record", str(path)]
    # Under `nohup` a process and its children ignore SIGHUP.
    reset = partial(signal.signal, signal.SIGHUP, signal.SIG_DFL)
    child = subprocess.Popen([sys.executable, "-m", "app.cli.main", *words], cwd=ROOT, preexec_fn=reset)
    try:
        wait_for(lambda: path.exists() and path.stat().st_size > 2000)
        os.kill(child.pid, signal.SIGHUP)
        assert child.wait(LIMIT_S) == 0
    finally:
        child.kill()
    assert finished(path) and read_recording(path).rows > 0
