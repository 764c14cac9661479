"""Readers in a process of their own: what ends them, what holds them up, and what becomes of them, is told here."""

import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest

from estimators.errors import SourceError
from sources import reader_process as module
from sources.reader_process import Apart, ReaderError, ask
from tests.sources.readers_that_fail import abort, counting, fail, folder, hang, leave, pid_then, shout


def item_of(apart):
    """The next item, however long this machine takes to start a process."""
    while (item := apart.take(1.0)) is None:
        assert not apart.ended
    return item


def gone(pid):
    """Wait until a process has ended; a zombie has."""
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        try:
            with open(f"/proc/{pid}/stat") as file:
                if file.read().rpartition(")")[2].split()[0] == "Z":
                    return True
        except OSError:
            return True
        time.sleep(0.01)
    return False


def test_items_come_in_order_and_the_end_is_known():
    assert ask(counting, 10_000) == list(range(10_000))
    assert ask(counting, 0) == []


@pytest.mark.parametrize(
    ("failure", "expected"),
    [(abort, "its reader was ended by SIGABRT"), (leave, "its reader ended with status 3"), (fail, "wants to leave")],
)
def test_a_reader_that_ends_is_an_error_of_the_file_alone(failure, expected):
    apart = Apart(pid_then, failure)
    pid = item_of(apart)
    assert pid != os.getpid()
    with pytest.raises(ReaderError, match=expected):
        item_of(apart)
    assert apart.ended and apart.take(0.0) is None
    assert isinstance(ReaderError(""), SourceError)


def test_a_reader_that_hangs_is_ended():
    apart = Apart(pid_then, hang)
    pid = item_of(apart)
    apart._patience = 0.05
    with pytest.raises(ReaderError, match=r"gave nothing for 0 s and was ended"):
        while True:
            assert apart.take(0.01) is None
    assert gone(pid)


def test_time_in_which_nobody_waits_does_not_count(monkeypatch):
    """A machine that was suspended, or a twin that was paused, has no reader that hangs."""
    apart = Apart(pid_then, hang, patience=3600.0)
    item_of(apart)
    now = [0.0]

    class Slow:
        @staticmethod
        def monotonic():
            now[0] += 10_000.0
            return now[0]

    monkeypatch.setattr(module, "time", Slow)
    for _ in range(5):
        assert apart.take(0.01) is None
    monkeypatch.undo()
    apart.close()


def test_what_a_library_prints_is_no_item():
    apart = Apart(pid_then, shout)
    item_of(apart)
    while not apart.ended:
        assert apart.take(1.0) is None


def test_a_reader_is_used_again_and_one_that_is_left_is_not_waited_for():
    first, second = (ask(pid_then, print)[0] for _ in range(2))
    assert first == second
    apart = Apart(pid_then, hang)
    pid = item_of(apart)
    apart.close()
    assert gone(pid) and apart.ended
    endless = Apart(counting, 10**12)
    item_of(endless)
    endless.close()
    assert ask(counting, 3) == [0, 1, 2]


def test_a_reader_that_is_used_again_follows_its_parent_to_another_folder(tmp_path, monkeypatch):
    ask(folder)
    monkeypatch.chdir(tmp_path)
    assert ask(folder) == [str(tmp_path)]


def test_a_reader_that_is_left_with_its_source_is_ended():
    """Whatever order a collection of circular garbage takes: no descriptor is closed twice."""

    class Source:
        def __init__(self):
            self.apart = Apart(pid_then, hang)
            self.pid = item_of(self.apart)
            self.batches = self.all()
            next(self.batches)

        def all(self):
            try:
                yield self
            finally:
                self.apart.close()

    pids = [Source().pid for _ in range(3)]
    gc.collect()
    assert all(map(gone, pids)) and ask(counting, 2) == [0, 1]


def test_a_spare_reader_that_died_is_replaced():
    pid = ask(pid_then, print)[0]
    os.kill(pid, signal.SIGKILL)
    assert gone(pid)
    assert ask(counting, 2) == [0, 1]


def _ask(connection):
    connection.send(ask(pid_then, print)[0])


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="there is no fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_process_that_forks_keeps_its_readers():
    mine = ask(pid_then, print)[0]
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    child = context.Process(target=_ask, args=(there,))
    child.start()
    theirs = here.recv()
    child.join()
    assert theirs != mine and ask(pid_then, print)[0] == mine


PARENT = """
import sys
sys.path[:0] = {paths!r}
from tests.sources.readers_that_fail import hang, pid_then
from sources.reader_process import Apart
apart = Apart(pid_then, hang)
while (pid := apart.take(1.0)) is None:
    pass
print(pid, flush=True)
while True:
    apart.take(1.0)
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
    assert gone(pid)
