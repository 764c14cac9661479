"""Store of a running twin: an SQLite file from which it continues after a restart, a kill or a power failure.

The file has one table of parts: rows of events, the base of their fold, settings, runs, notes, the state of the checks
on entry, and open alerts. Each transaction replaces the parts that have changed since the last one, so the file always
has a complete state of the twin; it is as long as the twin's history. A process keeps it locked while it runs.
"""

from __future__ import annotations

import json
import sqlite3
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from config.tunings import OWN_VALUES
from estimators.diagnostics.episodes import Episode, TrackedEpisode
from estimators.errors import NisusError, SourceError, reason_of
from estimators.fold_checks import check_base
from estimators.log import Events, Log
from sources.source import Marked

from ..format_time import counted, duration_text, format_time
from ..result import JsonObject
from ..twin.changes import difference, merged, shape
from ..twin.twin import VERSION, Twin, restore_twin, with_version
from .copies import LogTail
from .engine import Engine
from .fold_json import (
    base_from_json,
    base_to_json,
    tuning_from_json,
    tuning_to_json,
    version_from_json,
    version_to_json,
)
from .jobs import Job, Jobs
from .notices import MAX_COMMANDS, Annotation, AuditEntry
from .revisions import Revision
from .running_fold import StoredTwin

FORMAT = 2
APPLICATION_ID = 0x4E697375
"""Marks an SQLite file as a store, in its header."""

WRITE_PERIOD_S, MIN_WRITE_PERIOD_S = 0.4, 0.02
"""Seconds between two transactions, and at least while a sender waits for each."""

MAX_LOSS_S = 1.0
"""Seconds of measurements that a kill may lose; a transaction that takes longer is reported."""

RETRY_PERIOD_S = 10.0
"""Seconds until the next attempt after the file could not be written, for example while the disk is full."""

SHORT_ROW_EVENTS, MAX_SHORT_ROWS, MAX_SHORT_EVENTS = 1024, 256, 4096
"""Rows of fewer events are joined once there are so many of them, or they have so many events."""

MAX_WAL_BYTES = 4 * 2**20
"""Size to which the write-ahead log is cut after a long transaction."""

EVENTS, COMMANDS, ALERTS = "events", "command", "alerts"

MAX_STORED_COMMANDS = 100_000
"""Commands of users that are kept; about 20 MB."""

DAMAGED = "is damaged; remove it, or choose another path"


class Store:
    """The file: it is locked, read once, and then written, from any thread."""

    def __init__(self, path: Path) -> None:
        """Open the file, or create it.

        Raises:
            SourceError: If it cannot be opened or written, is locked, or is no store of this version.
        """
        self.path = path
        self._lock = threading.RLock()
        self._rows: list[tuple[int, int]] = []
        """First index and number of the events of each row."""
        self._connect()

    def _connect(self) -> None:
        with self._failing():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(self.path, timeout=0.0, isolation_level=None, check_same_thread=False)
        try:
            with self._failing():
                self._open()
        except BaseException:
            self._file.close()
            raise
        self._identity = _identity(self.path)

    def _check_file(self) -> None:
        """Raise if the file has been removed, and begin another one with its content, or if it has been replaced."""
        if (now := _identity(self.path)) == self._identity:
            return
        if now is not None:
            raise self._error("another file was put in its place; stop the twin to continue from that, or remove it")
        with self._failing():
            removed = self._file
            self._connect()
            removed.backup(self._file)
            removed.close()
        raise self._error("the file was removed, a new one is begun")

    def _open(self) -> None:
        run = self._file.execute
        run("PRAGMA locking_mode=EXCLUSIVE")
        # The lock is that of the first write: all readings come after it.
        tables = run("SELECT count(*) FROM sqlite_master").fetchone()[0]
        application, known = (run(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version"))
        if tables and application != APPLICATION_ID:
            raise self._error("is no store of Nisus; choose another path")
        if tables and known != FORMAT:
            raise self._error(f"has format {known}, this version reads {FORMAT}; remove it, or choose another path")
        run("PRAGMA journal_mode=WAL")
        run("PRAGMA synchronous=FULL")
        run(f"PRAGMA journal_size_limit={MAX_WAL_BYTES}")
        with self._transaction():
            if not tables:
                run(
                    "CREATE TABLE parts "
                    "(kind TEXT, at INTEGER, count INTEGER, crc INTEGER, data BLOB, PRIMARY KEY (kind, at))"
                )
                run(f"PRAGMA application_id={APPLICATION_ID}")
                run(f"PRAGMA user_version={FORMAT}")

    def parts(self) -> tuple[JsonObject, list[tuple[int, Events]], list[JsonObject]]:
        """Return the parts from JSON, the rows of events with the index of their first one, and the last commands.

        Raises:
            SourceError: If the file is damaged.
        """
        found: JsonObject = {}
        rows: list[tuple[int, Events]] = []
        commands: list[JsonObject] = []
        with self._failing():
            own = "kind != ? AND (kind != ? OR at > (SELECT max(at) FROM parts WHERE kind = ?) - ?)"
            for kind, at, count, data in self._read(own, ALERTS, COMMANDS, COMMANDS, MAX_COMMANDS):
                if kind == EVENTS:
                    rows.append((at, _events_from_bytes(data, count)))
                elif kind == COMMANDS:
                    commands.append(json.loads(data))
                else:
                    found[kind] = json.loads(data)
        self._rows = [(at, len(events)) for at, events in rows]
        # Of the first row, some may have been dropped from the history.
        begins = [*(at for at, _ in self._rows), found["state"]["end"]] if found else []
        ends = [at + count for at, count in self._rows] or [found["state"]["oldest"]] if found else []
        if begins[-len(ends) :] != ends or (rows and begins[0] > found["state"]["oldest"]):
            raise self._error(f"events are missing; it {DAMAGED}")
        return found, rows, commands

    def write(self, tail: LogTail, parts: Mapping[str, str], commands: Sequence[AuditEntry] = ()) -> None:
        """Replace parts, add commands and the events of a tail, and drop those that its log has dropped.

        All in one transaction.

        Raises:
            SourceError: If the file cannot be written; it is then unchanged.
        """
        rows = [] if tail.fresh else self._rows.copy()
        self._check_file()
        with self._failing(), self._transaction():
            if tail.fresh:
                self._file.execute("DELETE FROM parts WHERE kind = ?", (EVENTS,))
            while rows and sum(rows[-1]) > tail.first:
                # A late measurement has moved these events.
                at, _ = rows.pop()
                kept = self._events(at).select(slice(0, max(0, tail.first - at)))
                self._remove(at)
                if len(kept):
                    self._add(rows, at, kept)
            if len(tail.events):
                self._add(rows, tail.first, tail.events)
            while rows and sum(rows[0]) <= tail.oldest:
                self._remove(rows.pop(0)[0])
            self._join_short_rows(rows)
            for kind, text in parts.items():
                self._put(kind, 0, 0, text.encode())
            for entry in commands:
                self._put(COMMANDS, entry.number, 0, json.dumps(asdict(entry)).encode())
            if commands:
                oldest = commands[-1].number - MAX_STORED_COMMANDS
                self._file.execute("DELETE FROM parts WHERE kind = ? AND at <= ?", (COMMANDS, oldest))
        self._rows = rows

    def read_blocks(self, *kinds: str) -> dict[tuple[str, int], bytes]:
        """Return the blocks of `write_blocks` of some kinds by kind and number.

        Raises:
            SourceError: If the file is damaged.
        """
        with self._failing():
            found = self._read(f"kind IN ({', '.join('?' * len(kinds))})", *kinds)
            return {(kind, at): data for kind, at, _, data in found}

    def write_blocks(self, blocks: Mapping[tuple[str, int], bytes]) -> None:
        """Replace blocks of bytes, each with a kind and a number, in one transaction; raises as `write`."""
        self._check_file()
        with self._failing(), self._transaction():
            for (kind, at), data in blocks.items():
                self._put(kind, at, 0, data)

    def close(self) -> None:
        """Close the file."""
        with suppress(sqlite3.Error):
            self._file.close()

    def _join_short_rows(self, rows: list[tuple[int, int]]) -> None:
        begin = next((k + 1 for k in range(len(rows) - 1, -1, -1) if rows[k][1] >= SHORT_ROW_EVENTS), 0)
        short = rows[begin:]
        if len(short) < MAX_SHORT_ROWS and sum(count for _, count in short) < MAX_SHORT_EVENTS:
            return
        events = [self._events(at) for at, _ in short]
        for at, _ in short:
            self._remove(at)
        del rows[begin:]
        self._add(rows, short[0][0], Events.concat(events, 0))

    def _add(self, rows: list[tuple[int, int]], at: int, events: Events) -> None:
        self._put(EVENTS, at, len(events), _events_to_bytes(events))
        rows.append((at, len(events)))

    def _read(self, condition: str, *given: int | str) -> Iterator[tuple[str, int, int, bytes]]:
        """Yield kind, number, count of events, and data of parts in their order."""
        sql = f"SELECT * FROM parts WHERE {condition} ORDER BY kind, at"
        for kind, at, count, crc, data in self._file.execute(sql, given):
            if zlib.crc32(data) != crc:
                raise self._error(DAMAGED)
            yield kind, at, count, data

    def _put(self, kind: str, at: int, count: int, data: bytes) -> None:
        self._file.execute("REPLACE INTO parts VALUES (?, ?, ?, ?, ?)", (kind, at, count, zlib.crc32(data), data))

    def _events(self, at: int) -> Events:
        ((_, _, count, data),) = self._read("kind = ? AND at = ?", EVENTS, at)
        return _events_from_bytes(data, count)

    def _remove(self, at: int) -> None:
        self._file.execute("DELETE FROM parts WHERE kind = ? AND at = ?", (EVENTS, at))

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._file.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._file.execute("COMMIT")
        except BaseException:
            with suppress(sqlite3.Error):
                self._file.execute("ROLLBACK")
            raise

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """Lock; raise what SQLite or the operating system raises as `SourceError`, with the remedy."""
        try:
            with self._lock:
                yield
        except sqlite3.Error as error:
            code = getattr(error, "sqlite_errorcode", None)
            reason = REASONS.get(-1 if code is None else code & 0xFF, f"cannot be used ({error}); choose another path")
            raise self._error(reason) from None
        except OSError as error:
            raise self._error(f"cannot be opened ({error.strerror}); choose another path") from None

    def _error(self, reason: str) -> SourceError:
        return SourceError(f"store {self.path}: {reason}")


def _identity(path: Path) -> tuple[int, int] | None:
    """Return what distinguishes a file from another one of its name; None if there is none."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_dev, stat.st_ino


REASONS = {
    sqlite3.SQLITE_BUSY: "another process uses it; stop that, or choose another path",
    sqlite3.SQLITE_CANTOPEN: "cannot be opened; choose a path in a folder that can be written",
    sqlite3.SQLITE_READONLY: "cannot be written; change its permissions, or choose another path",
    sqlite3.SQLITE_PERM: "cannot be written; change its permissions, or choose another path",
    sqlite3.SQLITE_NOTADB: "is no store of Nisus; choose another path",
    sqlite3.SQLITE_CORRUPT: DAMAGED,
    sqlite3.SQLITE_FULL: "the disk is full; free some space",
    sqlite3.SQLITE_IOERR: "cannot be written or read, or the disk is full; free some space, or choose another path",
}
"""Messages by the error code of SQLite."""

_HEADER = struct.Struct("<II")  # Number of events, and of their value columns
_TYPES = ("<i8", "<i8", "<i1", "<i4", "<f8")


def _events_to_bytes(events: Events) -> bytes:
    columns = (np.ascontiguousarray(column, kind) for column, kind in zip(events, _TYPES, strict=True))
    return b"".join([_HEADER.pack(len(events), events.value.shape[1]), *(column.tobytes() for column in columns)])


def _events_from_bytes(data: bytes, count: int) -> Events:
    _, width = _HEADER.unpack_from(data)
    at, columns = _HEADER.size, []
    for kind, size in zip(_TYPES, (count, count, count, count, count * width), strict=True):
        column = np.frombuffer(data, kind, size, at)
        at += column.nbytes
        columns.append(column.astype(column.dtype.newbyteorder("=")))
    t, arrival, kinds, channel, value = columns
    return Events(t, arrival, kinds, channel, value.reshape(count, width))


def read_store(store: Store, twin: Twin) -> StoredTwin | None:
    """Return the state of a twin in its store, with changes of its files since; None if the store is new.

    Raises:
        SourceError: If the store is damaged, or of another twin.
    """
    parts, rows, commands = store.parts()
    if not parts:
        return None
    try:
        return _stored_twin(parts, rows, commands, twin)
    except Exception as error:  # noqa: BLE001  a file may hold anything; the twin runs without it
        reason = reason_of(error)
        remedy = "remove it, or choose another path"
        raise SourceError(f"store {store.path}: cannot be continued ({reason}); {remedy}") from None


def open_store(path: Path, twin: Twin) -> tuple[Store | None, StoredTwin | None, tuple[str, str]]:
    """Return the store of a twin, its state, and a notice (level, text); without a store if it cannot be used."""
    store = None
    try:
        store = Store(path)
        stored = read_store(store, twin)
    except Exception as error:  # noqa: BLE001  as above
        if store is not None:
            store.close()
        reason = str(error) if isinstance(error, NisusError) else f"store {path}: {type(error).__name__}: {error}"
        return None, None, ("warn", f"{reason}; the twin runs without it")
    if stored is None:
        return store, None, ("info", f"store {path}: a new one; the twin continues from it after a restart")
    return store, stored, ("info" if stored.closed else "warn", continued_text(path, stored, time.time()))


def _stored_twin(
    parts: JsonObject, rows: list[tuple[int, Events]], commands: list[JsonObject], twin: Twin
) -> StoredTwin:
    state, header = parts["state"], parts["twin"]
    version = None if header["version"] is None else version_from_json(header["version"])
    before = restore_twin(header["yaml"], header["path"], header["overrides"], version)
    old, new = shape(before.model), shape(twin.model)
    changed = [name for name in old if old[name] != new[name]]
    if changed:
        raise SourceError(f"the {changed[0]} of {twin.name} are others than those of {before.name}, which it is of")
    if VERSION not in twin.overrides and header["overrides"].get(VERSION, OWN_VALUES) != OWN_VALUES:
        with suppress(NisusError):  # removed meanwhile
            twin = with_version(twin, header["overrides"][VERSION])  # loaded on the page
    base = base_from_json(json.dumps(parts["base"]))
    events = Events.concat([item for _, item in rows], twin.model.width)
    events = events.select(slice(state["oldest"] - rows[0][0] if rows else 0, None))
    tuning, estimator = tuning_from_json(json.dumps(parts["tuning"]), before.model, before.tuning.baseline)
    estimator, tuning = merged(before, twin, estimator, tuning)
    if base is not None:
        check_base(base, twin.model)
    Log.resume(twin.model, base, events)
    # Of a store of the version before the files stand in a pair, beside the section.
    files = repr(twin.plan.log_files)
    same_source = before.config.source == twin.config.source and state["source"].endswith((files, f", {files})"))
    tail = LogTail(
        fresh=True,
        first=state["oldest"],
        events=events,
        oldest=state["oldest"],
        floor=state["floor"],
        base=base,
        estimator=estimator,
        tuning=tuning,
        taken=state["taken"] if same_source else 0,
        intake=state["intake"] if same_source else {},
    )
    runs = [_run_from_json(each, twin) for each in parts["runs"]]
    last = runs[-1]
    if more := difference(last.estimator, last.tuning, estimator, tuning):
        runs.append(Revision(last.number + 1, estimator, tuning, time.time(), more, why="files changed"))
    else:
        runs[-1] = replace(last, estimator=estimator, tuning=tuning)
    notes = tuple(Annotation(**each) for each in parts["annotations"])
    episodes = tuple(
        TrackedEpisode(tuple(each["key"]), each["at"], each["until"], Episode(*each["episode"]))
        for each in parts["episodes"]
    )
    _check_integers(list(parts["numbers"].values()))
    return StoredTwin(
        twin, tail, tuple(runs), notes, state["written"], state["closed"],
        numbers=parts["numbers"] if same_source else {},
        episodes=episodes,
        commands=tuple(AuditEntry(**each) for each in commands),
    )  # fmt: skip


def _check_integers(items: list) -> None:
    """Raise ValueError or TypeError unless nested lists hold integers only."""
    for item in items:
        if isinstance(item, list):
            _check_integers(item)
        else:
            int(item)


_RUN_FIELDS = ("number", "began", "loaded", "name", "note", "place", "why", "first", "gesture")


def _run_to_json(run: Revision) -> JsonObject:
    known = {name: getattr(run, name) for name in _RUN_FIELDS}
    return known | {"settings": tuning_to_json(run.tuning, run.estimator)}


def _run_from_json(values: JsonObject, twin: Twin) -> Revision:
    tuning, estimator = tuning_from_json(values["settings"], twin.model, twin.tuning.baseline)
    return Revision(estimator=estimator, tuning=tuning, **{name: values[name] for name in _RUN_FIELDS})


def continued_text(path: Path, stored: StoredTwin, now: float) -> str:
    """Return the notice of a twin that continues; `now` in s since 1970."""
    since = now - stored.written
    at = format_time(round(stored.written * 1e9))
    line = f"continued from {path} with {counted(len(stored.tail.events), 'event')}"
    if since < 0.0:
        line += f"; the clock of this machine was set back by {duration_text(-since)} or more since {at}"
    elif stored.closed:
        line += f"; it was stopped {duration_text(since)} ago"
    if stored.closed:
        return line
    ended = f"the process was killed after its last write at {at}"
    return f"{line}; {ended}, and at most {MAX_LOSS_S:g} s of measurements before it ended is lost"


class StoreWriter:
    """Writes a running twin into its store, in a repeated job."""

    def __init__(self, engine: Engine, store: Store, stored: StoredTwin | None) -> None:
        """Begin with the content of the store, which the engine has not changed yet."""
        self._engine, self._store = engine, store
        self._cursor = engine.cursor(follows_log=True)
        self._written: JsonObject = {}
        self._mark, self._command = 0, 0
        self._failed = False
        self._episodes: tuple[object, tuple[TrackedEpisode, ...]] = ((), ())
        if stored is not None:
            engine.tail(self._cursor)
        if isinstance(engine.innermost, Marked):
            engine.innermost.restore({} if stored is None else stored.numbers)
        self._asked = threading.Event()
        self._pause = WRITE_PERIOD_S
        # A pool of its own: fits of minutes may take all threads of the engine's.
        self._jobs = Jobs(engine.notices, "store", threads=1, niceness=0)
        self._jobs.run("store", self._when_due, every=MIN_WRITE_PERIOD_S)

    def start(self) -> None:
        """Begin to write."""
        self._jobs.start()

    def request_write(self) -> None:
        """See `StateWriter`."""
        self._asked.set()

    def has(self, mark: int) -> bool | None:
        """See `StateWriter`."""
        return None if self._failed else self._mark >= mark

    def _when_due(self, job: Job) -> None:
        """Write when the time has come, or somebody waits for it."""
        self._asked.wait(self._pause)
        job.check()
        self._asked.clear()
        self._pause = self.write()

    def write(self, *, closed: bool = False) -> float:
        """Write what has changed; return the seconds to the next time."""
        begun = time.monotonic()
        try:
            self._write(closed)
        except Exception as error:  # noqa: BLE001  whatever a file system does, the twin goes on
            # Everything is written again, once that is possible.
            self._cursor.log = -1
            self._written.clear()
            self._failed = True
            reason = reason_of(error)
            text = f"{reason}; the twin goes on without it, and tries again"
            self._engine.notices.report("store", text, level="error", counted=False)
            return RETRY_PERIOD_S
        if self._failed:
            self._failed = False
            self._engine.notices.say(f"store {self._store.path}: it is written again")
        took = time.monotonic() - begun
        if took + WRITE_PERIOD_S > MAX_LOSS_S:
            text = f"store {self._store.path}: a write took {took:.2g} s; a kill may lose that much"
            self._engine.notices.report("slow store", text, counted=False)
        return WRITE_PERIOD_S

    def _write(self, closed: bool) -> None:
        engine = self._engine
        notes, runs, twin = engine.annotations.notes, engine.revisions.runs, engine.twin
        tail = engine.tail(self._cursor)
        source, commands = engine.innermost, engine.audit.entries(self._command)
        episodes = self._tracked_episodes()
        now: dict[str, tuple[object, Callable[[], str]]] = {
            "twin": (twin, partial(_twin_to_json, twin)),
            "base": (tail.base, partial(base_to_json, tail.base)),
            "tuning": ((tail.estimator, tail.tuning), partial(tuning_to_json, tail.tuning, tail.estimator)),
            "runs": (runs, lambda: json.dumps([_run_to_json(run) for run in runs])),
            "annotations": (notes, lambda: json.dumps([asdict(note) for note in notes])),
            "episodes": (episodes, lambda: json.dumps([{**entry._asdict(), "dropped": None} for entry in episodes])),
        }
        changed = {
            name: text()
            for name, (of, text) in now.items()
            if name not in self._written or not _is_same(of, self._written[name])
        }
        if isinstance(source, Marked) and (tail.mark != self._mark or "numbers" not in self._written):
            changed["numbers"] = json.dumps(source.numbers(tail.mark))
        elif "numbers" not in self._written:
            changed["numbers"] = "{}"
        if not (changed or commands or len(tail.events) or tail.fresh or closed):
            return
        state = {name: getattr(tail, name) for name in ("oldest", "end", "floor", "taken", "intake")}
        state |= {"source": repr(twin.plan.log_files), "written": time.time(), "closed": closed}
        self._store.write(tail, changed | {"state": json.dumps(state, default=_plain)}, commands)
        self._written = {name: of for name, (of, _) in now.items()} | {"numbers": None}
        self._mark = tail.mark
        self._command = commands[-1].change if commands else self._command

    def _tracked_episodes(self) -> tuple[TrackedEpisode, ...]:
        """Return the episodes; the same object as long as none has begun or ended."""
        entries = self._engine.tracked_episodes()
        key = [(entry.key, entry.at, *entry.episode[:4]) for entry in entries]
        if key != self._episodes[0]:
            self._episodes = key, entries
        return self._episodes[1]

    def stop(self) -> None:
        """Write the rest of an engine that has stopped, and close the store."""
        self._asked.set()
        self._jobs.stop()
        self.write(closed=True)
        self._engine.release(self._cursor)
        self._store.close()


def _is_same(one: object, other: object) -> bool:
    """Return whether two parts are the same objects."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(a is b for a, b in zip(one, other, strict=True))
    return one is other


def _twin_to_json(twin: Twin) -> str:
    version = None if twin.version is None else version_to_json(twin.version)
    header = {"name": twin.name, "path": str(twin.path), "yaml": twin.text, "overrides": dict(twin.overrides)}
    return json.dumps(header | {"version": version})


def _plain(value: np.ndarray | np.generic | Iterable[object]) -> object:
    """Return an array, number or queue of NumPy or Python for JSON."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else list(value)
