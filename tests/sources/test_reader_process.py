"""Readers in a process of their own: what ends them, what holds them up, and what becomes of them, is told here."""

import gc
import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from estimators.errors import SourceError
from sources import worker_process as module
from sources.worker_process import ITEM, IsolatedReader, ReaderError, read_isolated
from tests.sources.readers_that_fail import (
    abort,
    allocate,
    computing,
    counting,
    fail,
    folder,
    hang,
    leave,
    pid_then,
    shout,
)
from tests.waiting import wait_for

PATH = Path("recording")  # the functions do not read it


def item_of(reader):
    """The next item, however long this machine takes to start a process."""
    while (item := reader.get(1.0)) is None:
        assert not reader.ended
    return item


def gone(pid):
    """Whether a process has ended; a zombie has."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def wait_until_gone(*pids):
    wait_for(lambda: all(map(gone, pids)))


class Starved:
    """A worker that computes with a fifth of a processor, on a clock of its own; its item takes it so many seconds."""

    def __init__(self, seconds):
        self.seconds, self.now, self.used = seconds, 0.0, 0.0

    def monotonic(self):
        return self.now

    def submit(self, *_):
        pass

    def answer(self, timeout):
        self.now, self.used = self.now + timeout, self.used + timeout / 5.0
        return (ITEM, "read") if self.used > self.seconds else None

    def processor_time(self):
        return self.used

    def end(self, grace=0.0):
        return "was ended"


@pytest.mark.parametrize("seconds", [0.8, 60.0])
def test_time_in_which_others_have_the_processor_does_not_count(seconds, monkeypatch):
    """0.8 s of its own take 4 s, far longer than the 1.5 s that it may take."""
    worker = Starved(seconds)
    monkeypatch.setattr(module, "_hire", lambda: worker)
    monkeypatch.setattr(module, "time", worker)
    reader = IsolatedReader(counting, PATH, 1, timeout=1.5)
    if seconds < 1.5:
        while (item := reader.get(0.1)) is None:
            assert not reader.ended
        assert item == "read" and worker.now > 3.9
    else:
        with pytest.raises(ReaderError, match="gave nothing for 2 s and was ended"):
            while not reader.ended:
                reader.get(0.1)
        # The first wait counts in full, as no processor time was known before it: 0.1 + 70 × 0.02 = 1.5.
        assert worker.used == pytest.approx(71 * 0.02)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_processor_time_of_a_worker_is_known_while_it_computes():
    reader = IsolatedReader(computing, PATH)
    own = item_of(reader)
    begun = wait_for(reader._worker.processor_time)
    assert begun > own - 0.03  # user and system time, each rounded down to ticks of 10 ms
    wait_for(lambda: (reader._worker.processor_time() or 0.0) > begun + 0.1)
    reader.close()
    reader = IsolatedReader(pid_then, PATH, hang)
    item_of(reader)
    wait_for(lambda: reader._worker.processor_time() is None)
    reader.close()


def test_items_come_in_order_and_the_end_is_known():
    assert read_isolated(counting, PATH, 10_000) == list(range(10_000))
    assert read_isolated(counting, PATH, 0) == []


@pytest.mark.parametrize(
    ("failure", "expected"),
    [(abort, "its reader was ended by SIGABRT"), (leave, "its reader ended with status 3"), (fail, "wants to leave")],
)
def test_a_reader_that_ends_is_an_error_of_the_file_alone(failure, expected):
    reader = IsolatedReader(pid_then, PATH, failure)
    pid = item_of(reader)
    assert pid != os.getpid()
    with pytest.raises(ReaderError, match=expected):
        item_of(reader)
    assert reader.ended and reader.get(0.0) is None
    assert isinstance(ReaderError(""), SourceError)


@pytest.mark.skipif(sys.platform != "linux", reason="a limit of the Linux kernel")
def test_a_reader_that_takes_too_much_memory_is_refused_and_used_again():
    pid = read_isolated(pid_then, PATH, print)[0]
    with pytest.raises(ReaderError, match=r"recording: .*1\.0 GiB; save it uncompressed, or in smaller files"):
        read_isolated(allocate, PATH)
    assert read_isolated(pid_then, PATH, print)[0] == pid


def test_a_reader_that_hangs_is_ended():
    reader = IsolatedReader(pid_then, PATH, hang)
    pid = item_of(reader)
    reader._timeout = 0.05
    with pytest.raises(ReaderError, match=r"gave nothing for 0 s and was ended"):
        while True:
            assert reader.get(0.01) is None
    wait_until_gone(pid)


def test_time_in_which_nobody_waits_does_not_count(monkeypatch):
    """A machine that was suspended, or a twin that was paused, has no reader that hangs."""
    reader = IsolatedReader(pid_then, PATH, hang, timeout=3600.0)
    item_of(reader)
    now = [0.0]

    class Slow:
        @staticmethod
        def monotonic():
            now[0] += 10_000.0
            return now[0]

    monkeypatch.setattr(module, "time", Slow)
    for _ in range(5):
        assert reader.get(0.01) is None
    monkeypatch.undo()
    reader.close()


def test_what_a_library_prints_is_no_item():
    reader = IsolatedReader(pid_then, PATH, shout)
    item_of(reader)
    while not reader.ended:
        assert reader.get(1.0) is None


def test_a_reader_is_used_again_and_one_that_is_left_is_not_waited_for():
    first, second = (read_isolated(pid_then, PATH, print)[0] for _ in range(2))
    assert first == second
    reader = IsolatedReader(pid_then, PATH, hang)
    pid = item_of(reader)
    reader.close()
    assert reader.ended
    wait_until_gone(pid)
    endless = IsolatedReader(counting, PATH, 10**12)
    item_of(endless)
    endless.close()
    assert read_isolated(counting, PATH, 3) == [0, 1, 2]


def test_a_reader_that_is_used_again_follows_its_parent_to_another_folder(tmp_path, monkeypatch):
    read_isolated(folder, PATH)
    monkeypatch.chdir(tmp_path)
    assert read_isolated(folder, PATH) == [str(tmp_path)]


def test_a_reader_that_is_left_with_its_source_is_ended():
    """Whatever order a collection of circular garbage takes: no descriptor is closed twice."""

    class Source:
        def __init__(self):
            self.reader = IsolatedReader(pid_then, PATH, hang)
            self.pid = item_of(self.reader)
            self.batches = self.all()
            next(self.batches)

        def all(self):
            try:
                yield self
            finally:
                self.reader.close()

    pids = [Source().pid for _ in range(3)]
    gc.collect()
    wait_until_gone(*pids)
    assert read_isolated(counting, PATH, 2) == [0, 1]


def test_a_spare_reader_that_died_is_replaced():
    pid = read_isolated(pid_then, PATH, print)[0]
    os.kill(pid, signal.SIGKILL)
    assert read_isolated(counting, PATH, 2) == [0, 1]


def _ask(connection):
    connection.send(read_isolated(pid_then, PATH, print)[0])


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="there is no fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_process_that_forks_keeps_its_readers():
    mine = read_isolated(pid_then, PATH, print)[0]
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    child = context.Process(target=_ask, args=(there,))
    child.start()
    theirs = here.recv()
    child.join()
    assert theirs != mine and read_isolated(pid_then, PATH, print)[0] == mine


PARENT = """
import sys
sys.path[:0] = {paths!r}
from tests.sources.readers_that_fail import hang, pid_then
from pathlib import Path
from sources.worker_process import IsolatedReader
reader = IsolatedReader(pid_then, Path('recording'), hang)
while (pid := reader.get(1.0)) is None:
    pass
print(pid, flush=True)
while True:
    reader.get(1.0)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere a reader ends at its next item")
def test_a_reader_that_hangs_ends_with_its_parent():
    """Though no thread of it can run, and the parent was killed and could do nothing."""
    here = os.path.dirname(__file__)
    paths = [here, os.path.dirname(os.path.dirname(here))]
    with subprocess.Popen([sys.executable, "-c", PARENT.format(paths=paths)], stdout=subprocess.PIPE) as parent:
        pid = int(parent.stdout.readline())
        assert os.path.exists(f"/proc/{pid}")
        parent.kill()
        parent.wait()
    wait_until_gone(pid)
