"""A twin continues from its store, also after a kill, with the edits of its users; without a usable one it runs."""

import asyncio
import json
import re
import sqlite3
import sys
import zlib
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from app.engine.commands import Annotate, Note, SetEstimator, SetTuning
from app.engine.store import FORMAT, open_store
from app.twin.twin import load_twin
from app.web.readings import stored
from app.web.running import OpenedTwin, RunningTwin
from sources.source import ignore
from tests.app.scripted import Replayed, Scripted, Stepped, pull_all, random_walk, readings
from tests.benchmarks.kills import survive
from tests.support import SECOND, assert_same, run_python
from tests.waiting import wait_for

T0 = 1_700_000_000.0  # s; a live source has dates
HEADER = 100  # bytes of an SQLite file, among them a count of its openings


class Session(Stepped):
    """A running twin without threads, on a scripted source, and its store."""

    def __init__(self, path, source=None, twin=None, **options):
        """`options` are those of `OpenedTwin`."""
        self.source = source or Scripted(live=True)
        self.twin = twin or load_twin("motor_winding", overrides={"history": "2048"})
        make = self.source if callable(self.source) else lambda report: self.source
        self.running = RunningTwin(OpenedTwin(self.twin, make, store=path, **options), http_server=None)
        self.engine = self.running.engine
        self.engine.settle()

    def write(self):
        """Write the store."""
        self.running.store.write()
        return self

    def kill(self):
        """End as a killed process does: nothing more is written."""
        self.running.store._store.close()
        self.engine.stop()


@pytest.fixture
def path(tmp_path):
    """Where a store may be."""
    return tmp_path / "a.store"


def walk(n, begin=0, seed=1):
    """The measurements from `begin` to `n` of a random walk."""
    times, values = random_walk(n, seed)
    batch = readings(T0 + times[begin:], values[begin:])
    return batch._replace(arrival=batch.t + 1000)


def test_a_killed_process_leaves_the_states_of_an_undisturbed_fold(tmp_path):
    # For a machine that is busy with other tests; the benchmark has the limit of the guide.
    survive(3, tmp_path, limit=10.0)


def test_a_store_continues_bit_for_bit(tmp_path):
    """Base and history move while the twin runs in three processes, and some measurements are late."""
    path, undisturbed = tmp_path / "a.store", Session(None)
    batch = walk(9000)
    for begin in range(0, 9000, 3000):
        part = batch.select(slice(begin, begin + 3000))
        order = np.r_[0:990, 1000:3000]
        order = np.insert(order, 995, np.arange(999, 989, -1))
        first, rest = (part.select(rows) for rows in (order[:1500], order[1500:]))
        session = Session(path).put(first).write().put(rest).write()
        undisturbed.put(first, rest)
        mine, its = session.engine.here().base, undisturbed.engine.here().base
        for a, b in zip(mine, its, strict=True):
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
        session.kill()
    resumed, whole = pull_all(Session(path).engine), pull_all(undisturbed.engine)
    assert resumed.first == whole.first > 0
    assert_same(resumed.events, whole.events)
    # Health and mean NIS are of a window, of which a log that begins at a base lacks the rows before.
    later = slice(session.twin.policy.window, None)
    assert_same(resumed.track.select(later), whole.track.select(later))
    for name in ("mean", "std", "innovation", "nis"):
        np.testing.assert_array_equal(getattr(resumed.track, name), getattr(whole.track, name))


def test_edits_runs_and_notes_are_continued(path):
    before = Session(path).put(walk(500))
    before.submit(SetTuning("Q.temperature", 0.5)).submit(SetEstimator("ukf"))
    before.submit(Note(1, "wide"), Annotate("pump on", T0 + 20.0))
    before.running.stop()
    after = Session(path)
    assert (after.engine.estimator, after.engine.tuning.get("Q.temperature")) == ("ukf", 0.5)
    assert [(run.number, run.estimator, run.name) for run in after.engine.revisions.runs] == [
        (0, "kf", ""), (1, "kf", "wide"), (2, "ukf", ""),
    ]  # fmt: skip
    assert after.engine.status().revision == 2
    assert [note.text for note in after.engine.annotations.notes] == ["pump on"]
    assert_same(pull_all(after.engine).track, pull_all(before.engine).track)
    assert "continued from" in after.notices()[0] and "stopped" in after.notices()[0]
    after.running.stop()
    # A value that was changed in the twin's file or on the command line counts; the others stay as they were edited.
    changed = Session(path, twin=load_twin("motor_winding", overrides={"R.winding": "7"}))
    assert [changed.engine.tuning.get(key) for key in ("R.winding", "Q.temperature")] == [7.0, 0.5]
    assert changed.engine.revisions.runs[-1].why == "files changed"


def test_a_replay_continues_where_it_was(tmp_path):
    """It is read from its start again: what is in the store is skipped, and counts once."""
    path, batch = tmp_path / "a.store", walk(600)
    Session(path, Replayed()).put(batch.select(slice(0, 250))).write().kill()
    after = Session(path, Replayed()).put(batch.select(slice(0, 100)), batch.select(slice(100, None)))
    assert_same(pull_all(after.engine).events, pull_all(Session(None, Replayed()).put(batch).engine).events)
    after.source.restart()
    after.put(batch.select(slice(0, 100))).write().kill()
    assert pull_all(Session(path, Replayed()).engine).events.t.size == 100


def test_a_store_of_the_version_before_is_continued_with_its_source(path):
    """What it has of the twin and its source has the names of that version."""
    batch = walk(600)
    Session(path, Replayed()).put(batch.select(slice(0, 250))).write().kill()
    with closing(sqlite3.connect(path, isolation_level=None)) as file:
        parts = dict(file.execute("SELECT kind, data FROM parts WHERE kind IN ('twin', 'state')").fetchall())
        twin, state = (json.loads(parts[kind]) for kind in ("twin", "state"))
        assert "\ntime:\n" in twin["yaml"]
        twin |= {
            "yaml": twin["yaml"].replace("\ntime:\n", "\ntime:\n  horizon: 2\n"),
            "overrides": {"time.tick": "0.5"},
        }
        state["source"] = f"(SimulatorSection(where={{}}), {state['source']})"
        for kind, value in ("twin", twin), ("state", state):
            data = json.dumps(value).encode()
            file.execute("UPDATE parts SET data = ?, crc = ? WHERE kind = ?", (data, zlib.crc32(data), kind))
    after = Session(path, Replayed()).put(batch)
    assert "continued from" in after.notices()[0]
    assert_same(pull_all(after.engine).events, pull_all(Session(None, Replayed()).put(batch).engine).events)


@pytest.mark.parametrize("whose", ["source", "machine"])
@pytest.mark.parametrize("kill", [300, 500])
def test_a_clock_that_is_set_back_is_corrected_before_and_after_a_kill(tmp_path, whose, kill):
    """The clock is set back an hour after 300 measurements; the process is killed then, or 200 measurements later."""
    batch, hour = walk(900), 3600 * SECOND
    after = np.arange(900) >= 300
    batch = batch._replace(t=batch.t - hour * after, arrival=batch.arrival - hour * after * (whose == "machine"))
    parts = [batch.select(slice(k, k + 10)) for k in range(0, 900, 10)]
    Session(tmp_path / "a.store").put(*parts[: kill // 10]).write().kill()
    continued = Session(tmp_path / "a.store").put(*parts[kill // 10 :])
    undisturbed = Session(None).put(*parts)
    assert_same(pull_all(continued.engine).events, pull_all(undisturbed.engine).events)
    t = pull_all(undisturbed.engine).events.t
    assert t.size == 900 and np.all(np.abs(t - walk(900).t) <= 10**8), "they continue without a step"
    assert any(re.search(r"clock was set (3600|3599\.9) s back", text) for text in undisturbed.notices())


def damaged(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
    path.write_bytes(data)


def rewritten(sql, *given):
    """What spoils a store by this command of SQLite."""

    def spoil(path):
        with closing(sqlite3.connect(path, isolation_level=None)) as file:
            file.execute(sql, given)

    return spoil


def of_another_program(path):
    path.unlink()
    rewritten("CREATE TABLE songs (name TEXT)")(path)


WRONG = b'{"plc": [[1, "x"]]}'
NUMBERS = "UPDATE parts SET data = ?, crc = ? WHERE kind = 'numbers'"
ANOTHER = rewritten(f"PRAGMA user_version={FORMAT + 1}"), f"has format {FORMAT + 1}, this version reads {FORMAT}; rem"
"""A store of another version, and what is said of it."""


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (rewritten(NUMBERS, WRONG, zlib.crc32(WRONG)), "cannot be continued (ValueError: invalid literal"),
        (damaged, "is damaged; remove it, or choose another path"),
        (
            rewritten("DELETE FROM parts WHERE kind = 'events' AND at = (SELECT max(at) FROM parts)"),
            "events are missing; it is damaged; remove it, or choose another path",
        ),
        ANOTHER,
        (of_another_program, "is no store of Nisus; choose another path"),
        (lambda path: path.write_text("a: text\n" * 1000), "is no store of Nisus; choose another path"),
        (lambda path: (path.unlink(), path.mkdir()), "cannot be opened; choose a path in a folder that can be written"),
    ],
)
def test_a_store_that_cannot_be_used_is_one_line_and_stays_as_it_is(path, capsys, spoil, reason):
    Session(path).put(walk(3000)).running.stop()
    spoil(path)
    before = None if path.is_dir() else path.read_bytes()[HEADER:]
    session = Session(path).put(walk(50))
    line = capsys.readouterr().err
    assert line.startswith(f"nisus: store {path}: {reason}")
    assert line.endswith("; the twin runs without it\n") and line.count("\n") == 1
    assert session.engine.status().counts["readings"] == 50
    session.running.stop()
    assert before is None or path.read_bytes()[HEADER:] == before


def test_a_store_of_another_twin_or_in_use_is_left_alone(path, capsys):
    first = Session(path).put(walk(100)).write()
    second = Session(path).put(walk(20))
    assert f"store {path}: another process uses it; stop that" in capsys.readouterr().err
    assert second.engine.status().counts["readings"] == 20
    first.running.stop()
    store, stored, (level, text) = open_store(path, load_twin("lorenz63"))
    assert store is None and stored is None and level == "warn" and "the states of lorenz63 are others" in text


def pushed():
    """A source of messages, and a twin that has one."""
    twin = load_twin("motor_winding", overrides={"source": "{type: push}", "history": "2048"})
    return twin, twin.open_source(ignore)


def message(k):
    """Measurement `k` of a sender."""
    return {"time": round((T0 + k) * SECOND), "values": {"winding": 40.0 + k}, "source": "plc", "sequence": k}


def send(session, *numbers):
    """Send the measurements of these numbers; what became of them, and whether they are stored within the wait."""
    source = session.engine.innermost
    status = [answer.status for answer in source.send([message(k) for k in numbers])]
    return status, asyncio.run(stored(session.engine, source.accepted))


def test_what_is_acknowledged_survives_a_kill_and_is_taken_once(path, monkeypatch):
    monkeypatch.setattr("app.web.readings.STORE_TIMEOUT_S", 60.0)  # for a machine that is busy with other tests
    twin, source = pushed()
    before = Session(path, source, twin)
    before.running.start()
    assert send(before, *range(5)) == (["accepted"] * 5, True)
    before.kill()
    before.running.store._jobs.stop()
    twin, source = pushed()
    after = Session(path, source, twin)
    np.testing.assert_array_equal(pull_all(after.engine).events.value[:, 0], 40.0 + np.arange(5))
    # Its answer is lost: the sender repeats it. The next one is accepted, and the process killed before it is stored.
    monkeypatch.setattr("app.web.readings.STORE_TIMEOUT_S", 0.01)
    assert send(after, 4) == (["duplicate"], True)
    assert send(after, 5) == (["accepted"], False)
    after.kill()
    twin, source = pushed()
    last = Session(path, source, twin)
    answers = last.engine.innermost.send([message(5), message(0)])
    assert [item.status for item in answers] == ["accepted", "duplicate"]
    last.engine.settle()
    np.testing.assert_array_equal(pull_all(last.engine).events.value[:, 0], 40.0 + np.arange(6))
    last.running.stop()


def test_without_a_store_nothing_is_acknowledged_as_stored():
    twin, source = pushed()
    assert send(Session(None, source, twin), 1) == (["accepted"], False)


def test_an_unexpected_failure_is_one_line_and_everything_is_written_later(path, monkeypatch):
    session = Session(path).put(walk(100)).write()
    with monkeypatch.context() as patch:
        patch.setattr("app.engine.store._events_to_bytes", lambda events: 1 / 0)
        session.put(walk(200, 100)).write()
    text = "ZeroDivisionError: division by zero; the twin goes on without it, and tries again"
    assert session.notices()[-1] == text
    session.put(walk(300, 200)).write()
    assert session.notices()[-1] == f"store {path}: it is written again"
    session.kill()
    assert pull_all(Session(path).engine).events.t.size == 300


def test_a_file_that_is_removed_is_begun_again(path):
    session = Session(path).put(walk(100)).write()
    session.running.store._store.write_blocks({("alerts", 0): b"of another thread"})
    path.unlink()
    session.put(walk(200, 100)).write()
    assert "the file was removed, a new one is begun" in session.notices()[-1]
    session.put(walk(300, 200)).write().kill()
    after = Session(path)
    assert pull_all(after.engine).events.t.size == 300
    assert [*after.running.store._store.read_blocks("alerts").values()] == [b"of another thread"]


def test_a_file_that_is_replaced_is_left_alone(tmp_path):
    path, other = tmp_path / "a.store", tmp_path / "b.store"
    session = Session(path).put(walk(100)).write()
    Session(other).put(walk(10)).running.stop()
    content = other.read_bytes()
    other.rename(path)
    session.put(walk(400, 300)).write()
    assert "another file was put in its place; stop the twin to continue from that" in session.notices()[-1]
    session.kill()
    assert path.read_bytes() == content


def test_episodes_that_left_the_history_are_continued(path):
    batch = walk(9000)
    batch.value[200:400] += 30.0
    first = Session(path)

    def found():
        return [episode for episode in first.engine.episodes() if episode.cause != "corrected"]

    first.running.start()
    for begin in range(0, 9000, 500):
        first.source.put(batch.select(slice(begin, begin + 500)))
        wait_for(lambda begin=begin: first.engine.status().counts["readings"] == begin + 500)
        if begin == 1000:  # before the rows are dropped, however late the job is
            wait_for(
                lambda: sum(one.end is not None and one.cause != "corrected" for one in first.engine.episodes()) == 2
            )
    first.running.stop()
    before = [episode[:4] for episode in found()]
    oldest = first.engine.span()[0] * 1e-9
    assert sum(end is not None and end < oldest for _, end, _, _ in before) == 2
    assert sum(end is None and start < oldest for start, end, _, _ in before) == 1
    after = Session(path)
    after.running.start()
    # The cause of the one that lasts is judged by the rows that are left.
    known = {(subject, start, end) for start, end, subject, _ in before}
    wait_for(lambda: known <= {(subject, start, end) for start, end, subject, *_ in after.engine.episodes()})
    after.running.stop()


def test_commands_of_users_are_kept(path, monkeypatch):
    """Those of one gesture are one entry; only the last ones are read again."""
    monkeypatch.setattr("app.engine.store.MAX_COMMANDS", 3)
    before = Session(path).put(walk(50))
    audit, ann = before.engine.audit, ("ann", "tune", "10.0.0.3")
    for value in range(5):
        audit.add(ann, "/api/command", {"command": "SetTuning", "value": value, "gesture": "g"})
    before.write()
    audit.add(ann, "/api/command", {"command": "SetTuning", "value": 9, "gesture": "g"})
    for name in ("Reset", "Undo", "Redo"):
        audit.add(("bob", "admin", "10.0.0.4"), "/api/command", {"command": name})
    entries = audit.entries()
    assert [entry.body.get("value", entry.body["command"]) for entry in entries] == [9, "Reset", "Undo", "Redo"]
    before.write().kill()
    after = Session(path)
    assert [replace(entry, change=0) for entry in entries[1:]] == after.engine.audit.entries()
    after.engine.audit.add(ann, "/api/command", {"command": "Restore"})
    assert [entry.number for entry in after.engine.audit.entries()] == [1, 2, 3, 4]
    after.running.stop()


FULL = """
import resource, signal, sys
from pathlib import Path
from tests.app.engine.test_store import Session, walk
session = Session(Path(sys.argv[1])).put(walk(100)).write()
_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (70_000, hard))
session.put(walk(3000, 100)).write()
assert session.engine.status().counts["readings"] == 3000
print(session.notices()[-1])
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
session.put(walk(3001, 3000)).write()
print(session.notices()[-1])
session.kill()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="has no limit of file sizes")
def test_a_full_disk_is_one_line_and_everything_is_written_once_there_is_room(path):
    told = run_python(FULL, path)
    failed, again = told.stdout.splitlines()
    assert failed.startswith(f"store {path}: ") and "the disk is full" in failed
    assert failed.endswith("the twin goes on without it, and tries again")
    assert again == f"store {path}: it is written again"
    assert pull_all(Session(path).engine).events.t.size == 3001
