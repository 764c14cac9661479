"""Recordings: what is read back is what was seen, and folds again to the same bits."""

import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
import rerun as rr

from app.engine import commands
from app.engine.copies import Pull
from app.engine.engine import Engine
from app.engine.fold_json import tuning_from_json
from app.record import writer
from app.record.format import RecordingFile
from app.record.reader import finished, read_recording
from app.record.writer import Recorder
from app.scene.scene import History
from estimators.diagnostics.score import score
from estimators.errors import SourceError
from estimators.fold import fold
from estimators.log import TRUTH, Events, Log
from estimators.track import Track
from estimators.tuning import Tuning
from tests import ROOT
from tests.app.record.test_parts import refold
from tests.app.scripted import MODEL, Scripted, notice_texts, pull_all, readings, twin
from tests.support import SECOND, as_log, assert_same, error_of, run_python
from tests.waiting import LIMIT_S, wait_for


def drawn(stream):
    return lambda pull: None


@pytest.fixture
def running():
    source = Scripted()
    engine = Engine(twin(), lambda report: source)
    recorder = engine.recorder = Recorder(engine, drawn)
    engine.start()
    yield source, engine, recorder
    engine.stop()
    recorder.stop()


def steady(count, every=0.005):
    """Log and track of `count` equal readings, as the child process below sends them."""
    log = as_log(readings(np.arange(1, count + 1) * every, np.full(count, 40.0)))
    return log, fold("kf", MODEL, Tuning.of(MODEL), log, pairs=np.array([[0, 1]]))


def test_recording_holds_history_late_readings_and_retunes(running, tmp_path):
    source, engine, recorder = running
    rng = np.random.default_rng(3)
    times = np.arange(1, 2001) * 0.01
    values = 40 + rng.normal(size=2000)
    source.put(readings(times[:500], values[:500]))
    wait_for(lambda: len(pull_all(engine).events) == 500)
    path = tmp_path / "run.rrd"
    engine.submit(commands.Record(path))
    wait_for(lambda: recorder.path == path)
    late = [700, 701, 1500]
    for start in range(500, 2000, 100):
        piece = np.setdiff1d(np.arange(start, start + 100), late)
        source.put(readings(times[piece], values[piece]))
        for k in late:
            if start <= k < start + 100:
                source.put(readings(times[[k]], values[[k]]))
    wait_for(lambda: len(pull_all(engine).events) == 2000)
    engine.submit(commands.SetTuning("Q.rate", 0.02))
    engine.submit(commands.SetEstimator("ukf"))
    wait_for(lambda: engine.status().estimator == "ukf" and not engine.status().refolding)
    wait_for(lambda: pull_all(engine).revision >= 1 and pull_all(engine).track.mean.shape[0] == 2000)
    seen = pull_all(engine)
    engine.submit(commands.Record(None))
    wait_for(lambda: recorder.finished == [path])
    recorded = read_recording(path)
    assert recorded.name == "scripted" and recorded.text == "model: motor_winding\n"
    np.testing.assert_array_equal(recorded.events.t, np.round(times * SECOND).astype(np.int64))
    np.testing.assert_array_equal(recorded.events.value[:, 0], values)
    assert_same(refold(recorded), seen.track)
    texts = notice_texts(engine)
    assert [text for _, _, text in recorded.notices] == texts[: len(recorded.notices)]
    assert any("recording into" in text for _, _, text in recorded.notices)
    tuning, estimator = tuning_from_json(recorded.tuning, MODEL)
    assert estimator == "ukf"
    assert tuning.get("Q.rate") == 0.02


def test_a_recording_is_listed_from_when_it_is_asked_for_until_it_is_finished(tmp_path):
    """It is ended while its file is only being begun, and the next is asked for already."""
    going_on, source = threading.Event(), Scripted()
    engine = Engine(twin(), lambda report: source)
    recorder = engine.recorder = Recorder(engine, lambda stream: going_on.wait(LIMIT_S) and drawn(stream))
    engine.start()
    first, second = tmp_path / "first.rrd", tmp_path / "second.rrd"
    try:
        recorder.record(first)
        assert recorder.writing == first and recorder.written == [first]
        wait_for(first.exists)
        recorder.record(None)
        assert recorder.path is None and recorder.writing == first and recorder.written == [first]
        recorder.record(second)
        recorder.record(None)
        assert recorder.writing == first and recorder.written == [first]
        going_on.set()
        wait_for(lambda: recorder.finished == [first, second])
        wait_for(lambda: recorder.writing is None)
        assert recorder.written == [first, second]
    finally:
        going_on.set()
        engine.stop()
        recorder.stop()


def test_a_recording_that_is_being_finished_is_among_the_files(running, tmp_path, monkeypatch):
    source, engine, recorder = running
    path = tmp_path / "run.rrd"
    source.put(readings([1.0, 2.0], [40, 41]))
    seen, release = [], writer.RecordingPart.release

    def releasing(part):
        seen.append(list(recorder.written))
        release(part)

    monkeypatch.setattr(writer.RecordingPart, "release", releasing)
    engine.submit(commands.Record(path))
    wait_for(path.is_file)
    engine.submit(commands.Record(None))
    wait_for(lambda: recorder.finished == [path])
    wait_for(lambda: seen)
    assert seen == [[path]] and recorder.written == [path]


def test_place_that_cannot_be_written_is_one_line_and_the_twin_goes_on(running, tmp_path):
    source, engine, recorder = running
    (tmp_path / "file").write_text("")
    engine.submit(commands.Record(tmp_path / "file" / "run.rrd"))
    wait_for(lambda: any("recording" in line.text and line.level == "error" for line in engine.notices.since(0)))
    assert recorder.path is None
    source.put(readings([1.0], [40]))
    wait_for(lambda: len(pull_all(engine).events) == 1)


@pytest.mark.parametrize("content", [b"", b"not a recording", b"RRF2" + bytes(200)])
def test_what_is_no_recording_is_one_line(tmp_path, content):
    path = tmp_path / "x.rrd"
    path.write_bytes(content)
    assert str(path) in error_of(SourceError, read_recording, path)


def test_absent_recording_is_one_line(tmp_path):
    with pytest.raises(SourceError, match="there is no such recording"):
        read_recording(tmp_path / "none.rrd")


CHILD = """
import sys
sys.path.insert(0, {root!r})
import time
from pathlib import Path
from tests.app.scripted import Scripted, readings, twin
from app.engine import commands
from app.engine.engine import Engine
from app.record.writer import Recorder, RecordingPart
source = Scripted(live=True)
engine = Engine(twin(), lambda report: source)
write = RecordingPart.write
def written(part, **last):
    folded = engine.end()
    write(part, **last)
    print(folded, flush=True)
RecordingPart.write = written
engine.recorder = Recorder(engine, lambda stream: lambda pull: None)
engine.start()
engine.submit(commands.Record(Path({path!r})))
k = 0
while True:
    k += 1
    source.put(readings([k * 0.005], [40.0]))
    time.sleep(0.005)
"""


def test_killed_process_keeps_what_was_folded_before_its_last_write(tmp_path):
    """It writes more often than once a second, however fast the twin runs."""
    path = tmp_path / "killed.rrd"
    code = CHILD.format(root=str(ROOT), path=str(path))
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        kept = [int(next(child.stdout))]
        while kept[-1] < 800:
            kept.append(int(next(child.stdout)))
    finally:
        os.kill(child.pid, signal.SIGKILL)
        kept += map(int, child.stdout)
        child.wait()
    recorded = read_recording(path)
    assert recorded.rows >= kept[-1] and not recorded.closed
    assert len(kept) > 1 and writer.LOG_PERIOD_S < 1.0
    assert_same(refold(recorded), steady(recorded.rows)[1])


def test_truncated_recording_keeps_what_is_whole(tmp_path):
    """Cut in the middle of a message, as by a full disk: what was whole before it is there."""
    log, track = steady(1000, 0.01)
    path = tmp_path / "run.rrd"
    file = RecordingFile(path, twin(), None)
    file.tuning(Tuning.of(MODEL), "kf", 0, 0)
    file.flush()
    sizes = [path.stat().st_size]
    for start in range(0, 1000, 100):
        part = slice(start, start + 100)
        file.write(Pull(0, start == 0, start, log.events.select(part), track.select(part)))
        file.flush()
        sizes.append(path.stat().st_size)
    file.close()
    whole = path.read_bytes()
    cut = tmp_path / "cut.rrd"
    kept = []
    for size in (sizes[0] - 1, sizes[0]):  # with a tuning and without a row
        cut.write_bytes(whole[:size])
        with pytest.raises(SourceError, match="is a recording of Nisus, cut short before its first row"):
            read_recording(cut)
    # In bytes: as a share of the file, the first may be rounded down to less than the first rows.
    for size in np.linspace(sizes[1], len(whole), 12).astype(int):
        cut.write_bytes(whole[:size])
        recorded = read_recording(cut)
        assert finished(cut) == (size == len(whole))
        kept.append(recorded.rows)
        assert_same(refold(recorded), track.select(slice(0, recorded.rows)))
    assert kept == sorted(kept) and kept[-1] == 1000 and len(set(kept)) > 5


def test_a_recording_cut_before_its_first_row_is_told_from_another_programs(tmp_path):
    """Whatever its length, and also without its end; another program's is that, cut or whole."""
    path, cut = tmp_path / "run.rrd", tmp_path / "cut.rrd"
    RecordingFile(path, twin(), None).close()
    stream = rr.RecordingStream("another", recording_id="its")
    stream.set_sinks(rr.FileSink(str(tmp_path / "other.rrd")))
    stream.log("words", rr.TextLog("hello"))
    stream.disconnect()
    ours, other = path.read_bytes(), (tmp_path / "other.rrd").read_bytes()

    def message(content):
        cut.write_bytes(content)
        return error_of(SourceError, read_recording, cut).removeprefix(f"{cut}: ")

    named = ours.index(b"nisus_scripted") + 60
    for length in [*np.linspace(named, len(ours) - 40, 9).astype(int).tolist(), len(ours) - 40]:
        expected = f"is a recording of Nisus, cut short before its first row: {length:,} bytes are there; "
        assert message(ours[:length]).startswith(expected)
    for length in (4, 11, 12, 27, 28, 60):
        assert message(ours[:length]).startswith(f"is cut short: {length} bytes")
    for content in (other, other[:-40], other[:1000], ours):  # the last is whole, and never began
        assert message(content).startswith("holds no recording of Nisus; record one with")


def test_recordings_with_one_true_value_an_event_read_back(tmp_path):
    """As they were written before true states came in blocks: one value column, two truth events a step."""
    rng = np.random.default_rng(5)
    t = np.arange(1, 51) * 0.1
    x = np.stack((40 + t, rng.normal(0, 0.1, 50)), axis=1)
    spoken = readings(t, x[:, 0] + rng.normal(0, 2, 50))
    old = Events.concat([spoken, *(Events.alike(TRUTH, spoken.t, x[:, k], k) for k in (0, 1))], 1)
    old = old.select(np.argsort(old.t, kind="stable"))
    path = tmp_path / "old.rrd"
    file = RecordingFile(path, twin(), None)
    file.tuning(Tuning.of(MODEL), "kf", 0, 0)
    file.write(Pull(0, True, 0, old, Track.allocate(150, 2, 1, 1)))
    file.close()
    recorded = read_recording(path)
    assert recorded.events.value.shape == (150, 1) and MODEL.width == 2
    log, blocks = Log(MODEL.width), Log(MODEL.width)
    log.extend(recorded.events)
    blocks.extend(spoken)
    blocks.extend(Events.alike(TRUTH, spoken.t, x))
    scores = [
        score(fold("kf", MODEL, Tuning.of(MODEL), events), events.events, MODEL).states for events in (log, blocks)
    ]
    assert scores[0] == scores[1] and list(scores[0]) == ["temperature", "rate"]


def test_variances_that_readings_bring_are_recorded(running, tmp_path):
    """From the first reading that brings one, in the middle of a file; charts go on."""
    source, engine, recorder = running
    path = tmp_path / "run.rrd"
    history = History(MODEL.nx, MODEL.width)
    cursor = engine.cursor()
    engine.submit(commands.Record(path))
    wait_for(lambda: recorder.path == path)
    for first, variance in ((1.0, np.nan), (2.0, 0.25), (3.0, np.nan)):
        plain = readings([first, first + 0.5], [40.0, 41.0])
        own = np.full((2, 1), variance)
        wide = np.hstack((plain.value, np.full((2, MODEL.width - plain.value.shape[1]), np.nan), own))
        source.put(plain if np.isnan(variance) else plain._replace(value=wide))
        # In the file before the next come: it has parts without variances, and parts with.
        wait_for(lambda n=2 * first: recorder._open is not None and recorder._open.file.rows == n)
        history.update(engine.pull(cursor))
    seen = pull_all(engine)
    engine.submit(commands.Record(None))
    wait_for(lambda: recorder.finished == [path])
    recorded = read_recording(path)
    variances = recorded.events.value[:, MODEL.width :]
    np.testing.assert_array_equal(variances[:, 0], [np.nan, np.nan, 0.25, 0.25, np.nan, np.nan])
    again = refold(recorded)
    assert_same(again, seen.track)
    innovation_std = again.innovation_std[:, 0]
    assert innovation_std[2] < innovation_std[1] and innovation_std[2] < innovation_std[4]
    np.testing.assert_array_equal(history.column("value")[:, 0], seen.events.value[:, 0])


@pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_FSIZE stands in for a full disk")
def test_a_file_that_takes_no_more_is_one_line_and_keeps_what_it_has(tmp_path):
    """In a process of its own, whose files may not grow beyond a limit."""
    path = tmp_path / "full.rrd"
    limited = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))\n" + CHILD
    code = limited.replace("while True", "while not engine.notices.counts().get('recording failed')")
    code += "print('LINE', [line.text for line in engine.notices.since(0) if line.level == 'error'])\n"
    code = code.format(root=str(ROOT), path=str(path))
    child = run_python(code, timeout=LIMIT_S)
    (said,) = [line for line in child.stdout.splitlines() if line.startswith("LINE")]
    assert f"recording failed: {path}: it can no longer be written" in said and said.count("recording failed") == 1
    recorded = read_recording(path)
    assert recorded.rows > 10
    assert_same(refold(recorded), steady(recorded.rows)[1])
