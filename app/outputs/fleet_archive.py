"""Archive of a fleet: the measurements of all assets in Parquet files, and the history of one asset from them.

Rows are appended to a journal once per second. A journal that is complete becomes a Parquet file whose rows are in the
order of the assets, so that the rows of one asset are in one or two groups of each file. A killed process leaves its
journal, which the next one completes.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.errors import SourceError
from estimators.events.batch import KIND_NAMES, READING, Events
from sources.source import Report

from .parts import DAY_NS, ArchivePlan, Part, lock, number_of, parts_of, remove_surplus

if TYPE_CHECKING:
    from estimators.model.state_space import StateSpaceModel

WRITE_PERIOD_S, RETRY_PERIOD_S = 1.0, 10.0
"""Seconds between two writes to the journal, and to the next attempt after a failure."""

MAX_WAITING = 2_000_000
"""Rows that wait for the disk; further ones are dropped and counted."""

JOURNAL = ".arrows"
"""Ending of a journal: a stream of Arrow batches, named by the number of its Parquet file."""


class FleetArchive:
    """Writes the events of a fleet from a thread of its own, so that the fold never waits for the disk."""

    def __init__(self, plan: ArchivePlan, model: StateSpaceModel, names: Sequence[str], report: Report) -> None:
        """Prepare; nothing is written yet.

        Args:
            plan: Folder, and the limits of its files.
            model: Model of the assets.
            names: Names of the assets by position; may grow.
            report: Called as report(key, text) for what cannot be written, from the thread of the archive.
        """
        self._folder, self._split = plan
        self._model, self._names, self._report = model, names, report
        self._waiting: list[tuple[np.ndarray, Events]] = []
        self._count = self._dropped = 0
        self._lock = threading.Lock()
        self._journal: Journal | None = None
        self._begun = self._failed = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="archive", daemon=True)

    def put(self, at: np.ndarray, events: Events) -> None:
        """Add events of the assets at the positions `at` (N,); from the thread that folds."""
        with self._lock:
            full = self._count + len(events) > MAX_WAITING
            self._dropped += full * len(events)
            if not full:
                self._waiting.append((at, events))
                self._count += len(events)

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def stop(self) -> None:
        """Write the rest, and complete the file."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)

    def _run(self) -> None:
        pause = 0.0
        while not self._stopping.wait(pause):
            pause = self.look()
        self.look(closing=True)

    def look(self, *, closing: bool = False) -> float:
        """Write the rows that wait, and with `closing` complete the file; return the seconds to the next time."""
        try:
            if not self._begun:
                self._begun = True
                complete_journals(self._folder)
            self._write(closing)
        except Exception as error:  # noqa: BLE001  whatever a file system does, the fleet goes on
            if not self._failed:
                reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
                text = f"archive {self._folder}: cannot be written ({reason}); the fleet goes on, and tries again"
                self._report("archive", text)
            self._failed = True
            return RETRY_PERIOD_S
        with self._lock:
            dropped, self._dropped = self._dropped, 0
        if dropped:
            self._report("archive", f"archive {self._folder}: {dropped:,} rows were dropped; the disk is too slow")
        self._failed = False
        return WRITE_PERIOD_S

    def _write(self, closing: bool) -> None:
        with self._lock:
            rows = self._waiting[:]
        split = self._split
        if rows:
            at, events = np.concatenate([at for at, _ in rows]), Events.concat([e for _, e in rows], self._model.width)
            day = int(events.t.max()) // DAY_NS
            if self._journal is not None and split.daily and day > self._journal.day:
                self._finish()
            if self._journal is None:
                complete_journals(self._folder)  # one that failed
                remove_surplus(self._folder, split, self._report)
                self._journal = Journal(self._folder, day)
            try:
                self._journal.write(rows_of(self._model, self._names, at, events))
            except BaseException:
                self._journal.abandon()
                self._journal = None
                raise
            with self._lock:
                del self._waiting[: len(rows)]
                self._count -= len(events)
        journal = self._journal
        if journal is not None and (closing or journal.size >= split.size or journal.age >= split.seconds):
            self._finish()

    def _finish(self) -> None:
        """Complete the journal, and remove the oldest files beyond the limits."""
        assert self._journal is not None
        self._journal.close()
        self._journal = None
        complete_journals(self._folder)
        remove_surplus(self._folder, self._split, self._report)


def rows_of(model: StateSpaceModel, names: Sequence[str], at: np.ndarray, events: Events) -> Any:
    """Return events of assets as a pyarrow.Table; columns as of the archive of a twin, and `asset`.

    Columns: `asset`, `t_ns`, `arrival_ns`, `event`, `channel`, `sensor` (null unless a measurement), `value_k`.
    """
    import pyarrow as pa

    used, code = np.unique(at, return_inverse=True)
    channel = np.where(events.kind == READING, events.channel, len(model.sensor_names))
    columns: dict[str, Any] = {
        "asset": pa.array([names[k] for k in used.tolist()], pa.string()).take(pa.array(code)),
        "t_ns": events.t,
        "arrival_ns": events.arrival,
        "event": pa.array(KIND_NAMES).take(pa.array(events.kind)),
        "channel": events.channel,
        "sensor": pa.array([*model.sensor_names, None], pa.string()).take(pa.array(channel)),
    }
    columns |= {f"value_{k}": events.value[:, k] for k in range(model.width)}
    return pa.table({name: np.ascontiguousarray(c) if isinstance(c, np.ndarray) else c for name, c in columns.items()})


class Journal:
    """Rows of a file that is not complete, in the order of arrival."""

    def __init__(self, folder: Path, day: int) -> None:
        """Open it under the number of the next Parquet file; `day` is that of its first rows.

        Raises:
            OSError: If that is not possible.
            SourceError: If another process writes into the folder.
        """
        folder.mkdir(parents=True, exist_ok=True)
        number = max(map(number_of, parts_of(folder)), default=0) + 1
        self._file = (folder / f"{number:06d}{JOURNAL}").open("xb")
        lock(self._file)
        self._writer: Any = None
        self._begun, self._end = time.monotonic(), 0
        self.day = day

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self._end

    @property
    def age(self) -> float:
        """Seconds since it was opened."""
        return time.monotonic() - self._begun

    def write(self, table: Any) -> None:
        """Append rows."""
        import pyarrow as pa

        if self._writer is None:
            self._writer = pa.ipc.new_stream(self._file, table.schema)
        self._writer.write_table(table)
        self._file.flush()
        self._end = self._file.tell()

    def abandon(self) -> None:
        """Close it after a failure; the rows before that are read."""
        with suppress(OSError):
            self._file.close()

    def close(self) -> None:
        """End the stream."""
        self._writer.close()
        self._file.close()


def complete_journals(folder: Path) -> None:
    """Make a Parquet file of each journal, with its rows in the order of the assets.

    Raises:
        OSError: If that is not possible.
        SourceError: If the disk is nearly full, or another process writes into the folder.
    """
    import pyarrow.compute as pc

    for path in sorted(folder.glob(f"*{JOURNAL}")):
        with path.open("rb") as file:
            if not lock(file):
                raise SourceError("another process writes into it; choose another folder")
            table = read_journal(path)
            complete = int(path.stem) in map(number_of, parts_of(folder))  # the process ended before the journal's end
            if table is not None and not complete:
                t = int(table["t_ns"][0].as_py())
                part = Part(folder)
                try:
                    order = pc.sort_indices(table, sort_keys=[("asset", "ascending")])  # stable
                    part.write(table.take(order), 0, t, t // DAY_NS)
                    part.close()
                except BaseException:
                    part.abandon()
                    raise
            path.unlink()


def read_journal(path: Path) -> Any:
    """Return the rows of a journal, which may be written to at present, as a pyarrow.Table; None without any."""
    import pyarrow as pa

    batches = []
    try:
        with path.open("rb") as file, pa.ipc.open_stream(file) as stream:
            while True:
                batches.append(stream.read_next_batch())
    except (StopIteration, OSError, pa.ArrowInvalid):  # the end, or a batch that is not complete
        pass
    return pa.Table.from_batches(batches) if batches else None


class AssetHistory:
    """Archived rows of one asset, each of which is read once."""

    def __init__(self, folders: Sequence[Path], asset: str) -> None:
        """`folders`: those of the fleet, one for each process."""
        self._folders, self._asset = folders, asset
        self._read: dict[Path, tuple[int, int]] = {}
        """Number of the last file of a folder, and how many rows of it were read."""

    def read(self, most: int) -> Any:
        """Return the rows since the last call in the order of time as a pyarrow.Table; None if there are none.

        Args:
            most: Rows of a folder after which older files are not read.

        Raises:
            SourceError: If a file is damaged.
        """
        import pyarrow as pa

        found = []
        for folder in self._folders:
            left, (last, seen) = most, self._read.get(folder, (0, 0))
            for number, rows in _pieces(folder, self._asset, last):
                # A journal that was completed has the rows of an asset in the same order.
                fresh = rows.slice(seen) if number == last else rows
                if number >= self._read.get(folder, (0, 0))[0]:
                    self._read[folder] = number, rows.num_rows
                found.append(fresh)
                left -= fresh.num_rows
                if left <= 0:
                    break
        table = pa.concat_tables(found[::-1]) if found else None
        return None if table is None or not table.num_rows else table.sort_by("t_ns")


def _pieces(folder: Path, asset: str, first: int) -> Iterator[tuple[int, Any]]:
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


def _rows_of_part(path: Path, asset: str) -> Any:
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
