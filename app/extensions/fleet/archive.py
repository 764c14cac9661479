"""Archive of a fleet: the measurements of all assets in Parquet files, and the history of one asset from them.

Rows are appended to a journal once per second, or before each transaction of the fleet's store, which has the length of
the journal. A journal that is complete becomes a Parquet file whose rows are in the order of the assets, so that the
rows of one asset are in one or two groups of each file. A killed process leaves its journal, which the next one cuts to
the length in the store, as the rows behind come again, and completes.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from app.engine.jobs import LoopThread
from app.extensions.archive.parts import DAY_NS, ArchivePlan, number_of, parts_of, remove_surplus
from app.result import JsonObject
from estimators.errors import SourceError
from estimators.events.batch import KIND_NAMES, READING, Events
from estimators.model.state_space import StateSpaceModel
from sources.source import Report
from sources.worker_process import gist

from .journal import JOURNAL, Journal, complete_journal, complete_journals, read_journal

if TYPE_CHECKING:
    from pyarrow import Table

WRITE_PERIOD_S, RETRY_PERIOD_S = 1.0, 10.0
"""Seconds between two writes to the journal, and to the next attempt after a failure."""

MAX_WAITING = 2_000_000
"""Rows that wait for the disk; further ones are dropped and counted."""


class FleetArchive:
    """Writes the events of a fleet from a thread of its own, so that the fold waits for the disk only with a store."""

    def __init__(
        self,
        plan: ArchivePlan,
        model: StateSpaceModel,
        names: Sequence[str],
        report: Report,
        stored: JsonObject | None = None,
    ) -> None:
        """Prepare; nothing is written yet.

        Args:
            plan: Folder, and the limits of its files.
            model: Model of the assets.
            names: Names of the assets by position; may grow, and have another one when an asset is forgotten.
            report: Called as report(key, text) for what cannot be written, also from the thread of the archive.
            stored: Last entry from `written` in the store; empty or None without one.
        """
        self._folder, self._split = plan
        self._model, self._names, self._report = model, names, report
        self._stored: JsonObject = {"store": os.urandom(8).hex(), "number": 0, "end": 0} | (stored or {})
        """Id of the store, number of the journal that was written with it last, and its length."""
        self._waiting: list[tuple[Sequence[str], np.ndarray, Events]] = []
        """Names of assets, the place of each event's among these, and the events."""
        self._count = self._dropped = 0
        self._lock = threading.Lock()
        self._journal: Journal | None = None
        self._writing = threading.Lock()
        """Held while the journal changes, and until the store has its length."""
        self._ended: list[Path] = []
        """Journals that become Parquet files."""
        self._begun = self._failed = False
        self._thread = LoopThread(self._run, "archive")

    def append(self, at: np.ndarray, events: Events) -> None:
        """Add events of the assets at the positions `at` (N,); from the thread that folds."""
        with self._lock:
            full = self._count + len(events) > MAX_WAITING
            self._dropped += full * len(events)
            if not full:
                self._waiting.append(self._named(at, events))
                self._count += len(events)

    def _named(self, at: np.ndarray, events: Events) -> tuple[Sequence[str], np.ndarray, Events]:
        used, code = np.unique(at, return_inverse=True)
        return [self._names[k] for k in used.tolist()], code, events

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def stop(self) -> None:
        """Write the rest, and complete the file."""
        self._thread.stop(10.0)

    def _run(self) -> None:
        pause = 0.0
        while not self._thread.stopping.wait(pause):
            pause = self.write()
        self.write(closing=True)

    @contextmanager
    def written(self, rows: Sequence[tuple[np.ndarray, Events]]) -> Iterator[JsonObject]:
        """Append events of assets at positions (N,) to the journal, for a transaction of the store in this context.

        Yields what the transaction must have: a process that continues from it cuts the journal there. Rows that cannot
        be written wait, as with `append`.
        """
        with self._writing:
            try:
                self._begin()
                if rows:
                    journal = self._append([self._named(*row) for row in rows], self._stored["store"])
                    self._stored |= {"number": journal.number, "end": journal.size}
            except Exception as error:  # noqa: BLE001  as in `write`
                self._fail(error)
                for at, events in rows:
                    self.append(at, events)
            yield self._stored

    def write(self, *, closing: bool = False) -> float:
        """Write the rows that wait, and with `closing` complete the file; return the seconds to the next time."""
        try:
            with self._writing:
                self._begin()
                self._write()
                journal, split = self._journal, self._split
                if journal is not None and (closing or journal.size >= split.size or journal.age >= split.seconds):
                    self._end()
            if self._ended:
                while self._ended:
                    complete_journal(self._ended[0])
                    del self._ended[0]
                remove_surplus(self._folder, self._split, self._report)
        except Exception as error:  # noqa: BLE001  whatever a file system does, the fleet goes on
            self._fail(error)
            return RETRY_PERIOD_S
        with self._lock:
            dropped, self._dropped = self._dropped, 0
        if dropped:
            self._report("archive", f"archive {self._folder}: {dropped:,} rows were dropped; the disk is too slow")
        self._failed = False
        return WRITE_PERIOD_S

    def _fail(self, error: Exception) -> None:
        if not self._failed:
            text = f"archive {self._folder}: cannot be written ({gist(error)}); the fleet goes on, and tries again"
            self._report("archive", text)
        self._failed = True

    def _begin(self) -> None:
        """Cut the journal of a process before this one, and complete all."""
        if not self._begun:
            complete_journals(self._folder, self._stored)
            self._begun = True

    def _write(self) -> None:
        with self._lock:
            rows = self._waiting[:]
        if rows:
            self._append(rows, "")
            with self._lock:
                del self._waiting[: len(rows)]
                self._count -= sum(len(events) for *_, events in rows)

    def _append(self, rows: Sequence[tuple[Sequence[str], np.ndarray, Events]], store: str) -> Journal:
        """Write rows to the journal of a store, or of none; that of a new day or of another store is a new one."""
        names = [name for row in rows for name in row[0]]
        firsts = np.cumsum([0, *(len(row[0]) for row in rows)])
        at = np.concatenate([code + first for (_, code, _), first in zip(rows, firsts, strict=False)])
        events = Events.concat([row[2] for row in rows], self._model.width)
        day = int(events.t.max()) // DAY_NS
        known = self._journal
        if known is not None and (known.store != store or (self._split.daily and day > known.day)):
            self._end()
        if self._journal is None:
            self._journal = Journal(self._folder, day, store, self._stored["number"])
        try:
            self._journal.write(rows_of(self._model, names, at, events))
        except BaseException:
            self._journal.abandon()
            self._ended.append(self._journal.path)
            self._journal = None
            raise
        return self._journal

    def _end(self) -> None:
        """End the journal."""
        assert self._journal is not None
        self._journal.close()
        self._ended.append(self._journal.path)
        self._journal = None


def rows_of(model: StateSpaceModel, names: Sequence[str], at: np.ndarray, events: Events) -> Table:
    """Return events of assets as a pyarrow.Table; columns as of the archive of a twin, and `asset`.

    Columns: `asset`, `t_ns`, `arrival_ns`, `event`, `channel`, `sensor` (null unless a measurement), `value_k`.
    """
    import pyarrow as pa

    used, code = np.unique(at, return_inverse=True)
    channel = np.where(events.kind == READING, events.channel, len(model.sensor_names))
    columns: dict[str, object] = {
        "asset": pa.array([names[k] for k in used.tolist()], pa.string()).take(pa.array(code)),
        "t_ns": events.t,
        "arrival_ns": events.arrival,
        "event": pa.array(KIND_NAMES).take(pa.array(events.kind)),
        "channel": events.channel,
        "sensor": pa.array([*model.sensor_names, None], pa.string()).take(pa.array(channel)),
    }
    columns |= {f"value_{k}": events.value[:, k] for k in range(model.width)}
    return pa.table(columns)


class AssetHistory:
    """Archived rows of one asset, each of which is read once."""

    def __init__(self, folder: Path, asset: str) -> None:
        """`folder`: that of the fleet."""
        self._folder, self._asset = folder, asset
        self._read = 0, 0
        """Number of the last file, and how many rows of it were read."""

    def read(self, most: int) -> Table | None:
        """Return the rows since the last call in the order of time as a pyarrow.Table; None if there are none.

        Args:
            most: Rows after which older files are not read.

        Raises:
            SourceError: If a file is damaged.
        """
        import pyarrow as pa

        found, (last, seen) = [], self._read
        for number, rows in _pieces(self._folder, self._asset, last):
            # A journal that was completed has the rows of an asset in the same order.
            fresh = rows.slice(seen) if number == last else rows
            if number >= self._read[0]:
                self._read = number, rows.num_rows
            found.append(fresh)
            most -= fresh.num_rows
            if most <= 0:
                break
        table = pa.concat_tables(found[::-1]) if found else None
        return None if table is None or not table.num_rows else table.sort_by("t_ns")


def _pieces(folder: Path, asset: str, first: int) -> Iterator[tuple[int, Table]]:
    """Yield number and rows of an asset of each file, the newest first; those from the number `first` on."""
    import pyarrow.compute as pc

    # Journals first: one that is completed meanwhile is then among the files.
    journals = {int(path.stem): read_journal(path) for path in folder.glob(f"*{JOURNAL}")}
    parts = parts_of(folder)
    complete = {number_of(path) for path in parts}
    for number, table in sorted(journals.items(), reverse=True):
        if table is not None and number not in complete:
            yield number, table.filter(pc.equal(table["asset"], asset))
    for path in reversed(parts):
        if number_of(path) < first:
            return
        with suppress(FileNotFoundError):  # removed as surplus
            yield number_of(path), _rows_of_part(path, asset)


def _rows_of_part(path: Path, asset: str) -> Table:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet

    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            column = file.schema_arrow.get_field_index("asset")
            groups = [
                k for k in range(file.num_row_groups)
                if (known := file.metadata.row_group(k).column(column).statistics) is None
                or not known.has_min_max or known.min <= asset <= known.max
            ]  # fmt: skip
            table = file.read_row_groups(groups)
    except (pa.ArrowInvalid, KeyError) as error:
        raise SourceError(f"{path}: it cannot be read as Parquet ({error}); remove it") from None
    return table.filter(pc.equal(table["asset"], asset))
