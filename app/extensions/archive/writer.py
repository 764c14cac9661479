"""Archive of a running twin: Parquet files with the rows of its fold, by day, time and size; the oldest are removed.

A row is written once no late measurement can change it (`Running.settled`), with the estimate that was published then.
Files are written under another name and renamed when they are complete, so a killed process loses at most the open one.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from app.engine.copies import Pull
from app.engine.history_copy import last_written
from app.engine.jobs import LoopThread
from app.engine.running_fold import Running, StoredTwin
from app.record.rrd_file import Split
from estimators.events.batch import MAINTENANCE
from estimators.interface.table import table_of
from estimators.log import Events
from sources.worker_process import gist

from .parts import DAY_NS, GROUP_ROWS, ArchivePlan, ParquetPart, parts_of, remove_surplus

if TYPE_CHECKING:
    from pyarrow import Table

PERIOD_S, IDLE_PERIOD_S = 0.05, 1.0
"""Seconds between two looks for rows, at least and, while there are none, at most."""

RETRY_PERIOD_S = 10.0
"""Seconds to the next attempt after a failure."""


class Archive:
    """Writes the rows of a running twin from a thread and with a cursor of its own; the engine never waits for it."""

    def __init__(self, engine: Running, plan: ArchivePlan, stored: StoredTwin | None = None) -> None:
        """Prepare; `stored` is the state that the twin continues, whose archived rows are not written again."""
        self._engine, self._folder, self._split = engine, plan.folder, plan.split
        self._cursor = engine.cursor(follows_log=True)
        self._next, self._versions = 0, _Versions()
        self._begin = 0 if stored is None else stored.tail.first
        self._part: ParquetPart | None = None
        self._failed = False
        self._grown = threading.Event()
        self._stored = stored
        report = partial(engine.notices.report, counted=False)
        self._remove_surplus = partial(remove_surplus, plan.folder, plan.split, report)
        self._thread = LoopThread(self._run, "archive")

    def start(self) -> None:
        """Begin to write."""
        self._engine.grown |= {self._grown.set}
        self._thread.start()

    def stop(self) -> None:
        """Write the rest of an engine that has stopped, and complete the file."""
        self._engine.grown -= {self._grown.set}
        self._thread.stop(10.0, self._grown.set)
        self._engine.release(self._cursor)

    def _run(self) -> None:
        pause = 0.0
        while not self._thread.stopping.wait(pause):
            self._grown.clear()
            pause = self.write()
            self._grown.wait(IDLE_PERIOD_S)
        self.write(closing=True)

    def write(self, *, closing: bool = False) -> float:
        """Write the rows that are settled, or with `closing` all; return the seconds to the next time."""
        try:
            self._write(closing)
        except Exception as error:  # noqa: BLE001  whatever a file system does, the twin goes on
            self._abandon()
            if not self._failed:
                text = f"archive {self._folder}: cannot be written ({gist(error)}); the twin goes on, and tries again"
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
            self._part = ParquetPart(self._folder)
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
                self._part = ParquetPart(self._folder)
            self._part.write(table, pull.first + start, int(events.t[start]), day)
            if self._part.size >= self._split.size:
                self._finish()

    def _table(self, pull: Pull, piece: slice) -> Table:
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


class _Versions:
    """Version of the model before a row, counted from the maintenance events before it."""

    def __init__(self, before: int = 1) -> None:
        self._first = before
        self._changes: list[tuple[int, int]] = []
        """Row and time of each maintenance event."""

    def before(self, first: int, events: Events) -> int:
        """Return the version before the row `first`, with which `events` begin, and note their maintenance."""
        self._changes = [change for change in self._changes if change[0] < first]
        times = {t for _, t in self._changes}
        rows = np.flatnonzero(events.kind == MAINTENANCE)
        # One maintenance may have several events, of which some were in the rows before.
        begun = bool(rows.size) and int(events.t[rows[0]]) in times
        self._changes += [(first + int(k), int(events.t[k])) for k in rows]
        return self._first + len(times) - begun


def archive_of(folder: Path, split: Split, engine: Running, stored: StoredTwin | None) -> Archive:
    """Return the archive of a running twin; `folder` is that of its own."""
    return Archive(engine, ArchivePlan(folder, split), stored)
