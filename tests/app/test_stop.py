"""A twin that is stopped: nothing waits for what does not concern it, and its recording has every row that there is."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from app.cli.open_twin import live_source
from app.engine.jobs import run_all
from app.record.reader import finished, read_recording
from app.record.writer import RecordingPart
from app.twin.twin import load_twin
from app.web.running import OpenedTwin, RunningTwin
from tests import ROOT
from tests.app.scripted import row_count
from tests.support import run_python
from tests.waiting import LIMIT_S, wait_for


def test_works_are_done_side_by_side_and_all_before_it_returns():
    meeting, done = threading.Barrier(3), []

    def work():
        meeting.wait(LIMIT_S)
        done.append(threading.current_thread())

    run_all(work, work, work)
    assert len(set(done)) == 3 and threading.current_thread() in done
    run_all()


SIGNALS_IN_WAIT = """
import os, signal, sys
from app.terminal import EndRequest, when_asked_to_end
done = EndRequest()
when_asked_to_end(done.set)
calls = []
def look(frame, event, arg):
    if frame.f_code is not look.__code__ and len(calls) < 50:
        calls.append(frame.f_code.co_name)
        os.kill(os.getpid(), signal.SIGTERM)
sys.setprofile(look)
while not done.wait(0.01):
    pass
sys.setprofile(None)
print(len(calls) > 2 and done.wait(0.0))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="os.kill ends a process there")
def test_a_signal_at_any_moment_of_the_wait_ends_it():
    assert run_python(SIGNALS_IN_WAIT, timeout=LIMIT_S).stdout == "True\n"


def test_what_fails_is_raised_once_all_are_done():
    failing, done = threading.Event(), []

    def fail():
        failing.set()
        raise OSError("it cannot be closed")

    def work():
        failing.wait(LIMIT_S)
        done.append(True)

    with pytest.raises(OSError, match="it cannot be closed"):
        run_all(work, fail, work)
    assert done == [True, True]


def test_the_recording_is_closed_after_the_last_row_and_has_it(tmp_path, monkeypatch):
    twin, path = load_twin("motor_winding"), tmp_path / "run.rrd"
    running = RunningTwin(OpenedTwin(twin, live_source(twin, 100.0)), http_server=None, recordings=tmp_path)
    order = []

    def end(part, *, short=False):
        # Who moves the rows has ended; what looks at the last of them too.
        assert not running.engine._thread.is_alive()
        assert running.engine._watchers.episode_log.tracker.n == row_count(running.engine)
        order.append(row_count(running.engine))
        ended(part, short=short)
        assert finished(path)
        order.append("closed")

    ended = RecordingPart.end
    monkeypatch.setattr(RecordingPart, "end", end)
    running.start()
    running.recorder.record(path)
    wait_for(lambda: path.exists() and row_count(running.engine) > 100)
    running.stop()
    assert order == [row_count(running.engine), "closed"]
    assert read_recording(path).rows == order[0] and not running.recorder._thread.is_alive()


@pytest.mark.skipif(not hasattr(signal, "SIGTERM") or os.name == "nt", reason="no such signal")
def test_a_page_that_is_asked_to_end_ends_well_and_its_recording_is_whole(tmp_path):
    path = tmp_path / "run.rrd"
    words = ["run", "motor_winding", "--port", "0", "--no-browser", "--speed", "50", "--record", str(path)]
    process = subprocess.Popen(
        [sys.executable, "-m", "app.cli.main", *words], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert any("http://" in line for line in process.stdout)
        wait_for(lambda: path.exists() and path.stat().st_size > 20_000)
        process.send_signal(signal.SIGTERM)
        assert process.wait(LIMIT_S) == 0
    finally:
        process.kill()
    recorded = read_recording(path)
    assert finished(path) and recorded.closed and recorded.rows > 0
