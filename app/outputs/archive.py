"""Archive of a running twin: Parquet files with the rows of its fold, by day, time and size; the oldest are removed.

A row is written once no late measurement can change it (`Running.settled`), with the estimate that was published then.
Files are written under another name and renamed when they are complete, so a killed process loses at most the open one.
"""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from estimators.errors import SourceError
from estimators.events.batch import MAINTENANCE
from estimators.interface.table import table_of

from ..live.history_copy import last_written
from ..live.outputs import Pull
from ..views.recording.rrd_file import Disk, Split

if TYPE_CHECKING:
    from ..live.running_fold import Running, StoredTwin

PERIOD_S, IDLE_PERIOD_S = 0.05, 1.0
"""Seconds between two looks for rows, at least and, while there are none, at most."""

RETRY_PERIOD_S = 10.0
"""Seconds to the next attempt after a failure."""

GROUP_ROWS = 8192
"""Rows that are written at once; fewer only at the end of a file."""

OPEN = ".open"
"""Ending of the file that is being written."""

DAY_NS = 86_400 * 10**9


class ArchivePlan(NamedTuple):
    """Folder of one twin, whose name is the twin's in the archive, and the limits of files and folder."""

    folder: Path
    split: Split


class Archive:
    """Writes the rows of a running twin from a thread and with a cursor of its own; the engine never waits for it."""

    def __init__(self, engine: Running, plan: ArchivePlan, stored: StoredTwin | None = None) -> None:
        """Prepare; `stored` is the state that the twin continues, whose archived rows are not written again."""
        self._engine, self._folder, self._split = engine, plan.folder, plan.split
        self._cursor = engine.cursor(follows_log=True)
        self._next, self._versions = 0, _Versions()
        self._begin = 0 if stored is None else stored.tail.first
        self._part: _Part | None = None
        self._failed = False
        self._stopping, self._grown = threading.Event(), threading.Event()
        self._stored = stored
        self._thread = threading.Thread(target=self._run, name="archive", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._engine.grown |= {self._grown.set}
        self._thread.start()

    def stop(self) -> None:
        """Write the rest of an engine that has stopped, and complete the file."""
        self._stopping.set()
        self._grown.set()
        self._engine.grown -= {self._grown.set}
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)
        self._engine.release(self._cursor)

    def _run(self) -> None:
        pause = 0.0
        while not self._stopping.wait(pause):
            self._grown.clear()
            pause = self.look()
            self._grown.wait(IDLE_PERIOD_S)
        self.look(closing=True)

    def look(self, *, closing: bool = False) -> float:
        """Write the rows that are settled, or with `closing` all; return the seconds to the next time."""
        try:
            self._write(closing)
        except Exception as error:  # noqa: BLE001  whatever a file system does, the twin goes on
            self._abandon()
            if not self._failed:
                reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
                text = f"archive {self._folder}: cannot be written ({reason}); the twin goes on, and tries again"
                self._engine.notices.say(text, level="error")
            self._failed = True
            return RETRY_PERIOD_S
        return PERIOD_S

    def _continue(self, stored: StoredTwin) -> None:
        """Begin after the last row that the archive and the stored log have in common."""
        import pyarrow.parquet

        parts, tail = parts_of(self._folder), stored.tail
        if not parts or not len(tail.events):
            return
        table = pyarrow.parquet.read_table(parts[-1], columns=["row", "t_ns", "arrival_ns", "model_version"])
        row, t, arrival, version = (column.to_numpy() for column in table.columns)
        at = row - tail.first
        known = last_written(row) & (at >= 0) & (at < len(tail.events))
        at = np.where(known, at, 0)
        same = np.flatnonzero(known & (tail.events.t[at] == t) & (tail.events.arrival[at] == arrival))
        if same.size:
            self._engine.pull(self._cursor, 0)
            self._next = self._cursor.next = int(row[same[-1]]) + 1
            self._versions = _Versions(int(version[same[-1]]))

    def _write(self, closing: bool) -> None:
        engine, cursor, stored = self._engine, self._cursor, self._stored
        if stored is not None:
            self._stored = None
            with suppress(Exception):  # a file that others wrote may hold anything; all rows are then written
                self._continue(stored)
        end = engine.end() if closing else engine.settled()
        if end == cursor.next and self._part is None:
            return
        if self._part is None:
            self._part = _Part(self._folder)
            self._remove_surplus()
        due = closing or time.monotonic() - self._part.begun >= self._split.seconds
        if not due and 0 <= end - cursor.next < min(GROUP_ROWS, engine.history // 4):
            return
        while True:
            pull = engine.pull(cursor, min(GROUP_ROWS, max(0, end - cursor.next)))
            self._take(pull)
            if not len(pull.events):
                break
        if due:
            self._finish()

    def _take(self, pull: Pull) -> None:
        """Write rows, each day into a file of its own."""
        if pull.fresh or pull.first == pull.oldest:
            self._versions = _Versions(pull.version)
        gap = pull.first - (self._begin if pull.fresh else self._next)
        if gap > 0:
            text = f"archive {self._folder}: {gap} rows left the history before they were written"
            self._engine.notices.report("archive", text, counted=False)
        events = pull.events
        self._next = pull.first + len(events)
        days = events.t // DAY_NS if self._split.daily else np.zeros(len(events), np.int64)
        edges = [0, *(np.flatnonzero(np.diff(days)) + 1).tolist(), len(events)]
        for start, stop in zip(edges, edges[1:], strict=False):
            if stop == start:
                continue
            if self._part is not None and self._part.day not in (None, days[start]):
                self._finish()
            table, day = self._table(pull, slice(start, stop)), int(days[start])
            if self._part is not None and self._part.writer is not None and self._part.writer.schema != table.schema:
                self._finish()
            if self._part is None:
                self._part = _Part(self._folder)
            self._part.write(table, pull.first + start, int(events.t[start]), day)
            if self._part.size >= self._split.size:
                self._finish()

    def _table(self, pull: Pull, piece: slice) -> Any:
        """Return rows as a table: the columns of `nisus fold --out`, and those of the archive."""
        import pyarrow as pa

        assert pull.settings is not None
        events, (tuning, _) = pull.events.select(piece), pull.settings
        first, n = pull.first + piece.start, len(events)
        table = table_of(
            tuning.model, events, pull.track.select(piece),
            tuning_version=tuning.version, tuning=tuning.name, model_version=self._versions.before(first, events),
        )  # fmt: skip
        table = table.replace_schema_metadata(None).add_column(0, "twin", pa.array([self._folder.name] * n))
        own = {
            "revision": np.full(n, pull.revision, np.int64),
            "row": first + np.arange(n, dtype=np.int64),
            "archived_ns": np.full(n, time.time_ns(), np.int64),
        }
        for name, values in own.items():
            table = table.append_column(name, pa.array(values))
        return table

    def _finish(self) -> None:
        """Complete the open file, and remove the oldest ones beyond the limits."""
        part, self._part = self._part, None
        if part is None:
            return
        try:
            part.close()
        except BaseException:
            self._part = part
            raise
        if self._failed:
            self._failed = False
            self._engine.notices.say(f"archive {self._folder}: it is written again")
        self._remove_surplus()

    def _abandon(self) -> None:
        """Remove the open file; its rows are written again if the history still has them."""
        part, self._part = self._part, None
        if part is not None:
            part.abandon()
            if part.first is not None:
                self._next = self._cursor.next = part.first

    def _remove_surplus(self) -> None:
        """Remove the oldest files beyond the size and age that are kept; the last one stays."""
        kept, split = 0.0, self._split
        for path in parts_of(self._folder)[::-1]:
            try:
                stat = path.stat()
                old = bool(kept) and (
                    kept + stat.st_size > split.kept_bytes or time.time() - stat.st_mtime > split.kept_seconds
                )
                kept += stat.st_size
                if old:
                    path.unlink()
            except OSError as error:
                self._engine.notices.report(
                    "kept archive", f"{path}: it cannot be removed ({error.strerror})", counted=False
                )


class _Versions:
    """Version of the model before a row, counted from the maintenance events before it."""

    def __init__(self, before: int = 1) -> None:
        self._first = before
        self._changes: list[tuple[int, int]] = []
        """Row and time of each maintenance event."""

    def before(self, first: int, events: Any) -> int:
        """Return the version before the row `first`, with which `events` begin, and note their maintenance."""
        self._changes = [change for change in self._changes if change[0] < first]
        times = {t for _, t in self._changes}
        rows = np.flatnonzero(events.kind == MAINTENANCE)
        # One maintenance may have several events, of which some were in the rows before.
        begun = bool(rows.size) and int(events.t[rows[0]]) in times
        self._changes += [(first + int(k), int(events.t[k])) for k in rows]
        return self._first + len(times) - begun


def parts_of(folder: Path) -> list[Path]:
    """Return the complete files of a twin in the order of writing."""
    found = [path for path in folder.glob("*-*.parquet") if path.stem.rpartition("-")[2].isdigit()]
    return sorted(found, key=_number)


def _number(path: Path) -> int:
    return int(path.stem.rpartition("-")[2])


class _Part:
    """File that is being written."""

    def __init__(self, folder: Path) -> None:
        """Open it under a number that is not taken.

        Raises:
            OSError: If that is not possible.
            SourceError: If the disk is nearly full, or another process writes into the folder.
        """
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob(f"*{OPEN}"):
            with left.open("rb") as file:
                if not _lock(file):
                    raise SourceError("another process writes into it; choose another folder")
            left.unlink(missing_ok=True)  # of a process that was killed
        if Disk(folder).free() < 0:
            raise SourceError("the disk is nearly full; free some space")
        self._number = max(map(_number, parts_of(folder)), default=0) + 1
        self._path = folder / f"{self._number:06d}.parquet{OPEN}"
        self._file = self._path.open("xb")
        _lock(self._file)
        self.writer: Any = None
        self.begun = time.monotonic()
        self.first: int | None = None
        """Absolute index of its first row; None while there is none."""
        self.day: int | None = None
        self._t = 0

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self._file.tell()

    def write(self, table: Any, first: int, t: int, day: int) -> None:
        """Append rows, the first of which has this absolute index and time, ns; `day` is that of all its rows."""
        import pyarrow.parquet

        if self.writer is None:
            self.first, self.day, self._t = first, day, t
            self.writer = pyarrow.parquet.ParquetWriter(self._file, table.schema, compression="zstd")
        self.writer.write_table(table)

    def close(self) -> None:
        """Complete the file and give it its name: the day of its first row, and its number."""
        if self.writer is None:
            self.abandon()
            return
        self.writer.close()
        self._file.flush()
        os.fsync(self._file.fileno())
        day = np.datetime64(self._t // DAY_NS, "D")
        self._path.rename(self._path.with_name(f"{day}-{self._number:06d}.parquet"))
        self._file.close()

    def abandon(self) -> None:
        """Remove the file."""
        with suppress(Exception):  # the writer writes the end of the file
            if self.writer is not None:
                self.writer.close()
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            self._path.unlink(missing_ok=True)


def _lock(file: Any) -> bool:
    """Lock a file for this process; return whether no other one has it."""
    try:
        import fcntl
    except ImportError:  # Windows, where an open file cannot be removed
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
