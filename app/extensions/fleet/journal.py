"""Journals of a fleet's archive: streams of Arrow batches, each of which becomes a Parquet file once it is complete."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from app.extensions.archive.parts import DAY_NS, ParquetPart, lock, number_of, parts_of
from app.result import JsonObject
from estimators.errors import SourceError

JOURNAL = ".arrows"
"""Ending of a journal: a stream of Arrow batches, named by the number of its Parquet file."""

STORE = b"store"
"""Key in the metadata of a journal: the id of the store that has its length."""


class Journal:
    """Rows of a file that is not complete, in the order of arrival."""

    def __init__(self, folder: Path, day: int, store: str, last: int) -> None:
        """Open it under the number of the next Parquet file.

        Args:
            folder: Of the archive.
            day: That of its first rows.
            store: Id of the store that has its length, or empty.
            last: Number of the last journal of the store, also in a folder that has been emptied since.

        Raises:
            OSError: If that is not possible.
        """
        folder.mkdir(parents=True, exist_ok=True)
        # Journals first: one that is completed meanwhile is then among the files.
        taken = [last, *(int(path.stem) for path in folder.glob(f"*{JOURNAL}")), *map(number_of, parts_of(folder))]
        self.number = max(taken) + 1
        self.path = folder / f"{self.number:06d}{JOURNAL}"
        self._file = self.path.open("xb")
        lock(self._file)
        self._writer: Any = None
        self._begun, self._end = time.monotonic(), 0
        self.day, self.store = day, store

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self._end

    @property
    def age(self) -> float:
        """Seconds since it was opened."""
        return time.monotonic() - self._begun

    def write(self, table: Any) -> None:
        """Append rows; those of a store are then on the disk, as those in the store are."""
        import pyarrow as pa

        if self._writer is None:
            self._writer = pa.ipc.new_stream(self._file, table.schema.with_metadata({STORE: self.store}))
        self._writer.write_table(table)
        self._file.flush()
        if self.store:
            os.fsync(self._file.fileno())
        self._end = self._file.tell()

    def abandon(self) -> None:
        """Close it after a failure; the rows before that are read, not those that failed, as they are written again."""
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            os.truncate(self.path, self._end)

    def close(self) -> None:
        """End the stream."""
        self._writer.close()
        self._file.close()


def complete_journals(folder: Path, stored: JsonObject | None = None) -> None:
    """Make a Parquet file of each journal; those of a store are cut to the length that it has.

    Args:
        folder: Of the archive.
        stored: See `FleetArchive.written`.

    Raises:
        OSError: If that is not possible.
        SourceError: If the disk is nearly full, or another process writes into the folder.
    """
    for path in sorted(folder.glob(f"*{JOURNAL}")):
        complete_journal(path, stored)


def complete_journal(path: Path, stored: JsonObject | None = None) -> None:
    """Make a Parquet file of a journal, with its rows in the order of the assets; see `complete_journals`."""
    import pyarrow.compute as pc

    folder, number = path.parent, int(path.stem)
    with path.open("rb") as file:
        if not lock(file):
            raise SourceError("another process writes into it; choose another folder")
        table = read_journal(path)
        if table is not None and stored is not None:
            own = (table.schema.metadata or {}).get(STORE, b"").decode()
            if own == stored["store"] and number >= stored["number"]:
                table = read_journal(path, stored["end"] if number == stored["number"] else 0)
        complete = number in map(number_of, parts_of(folder))  # the process ended before the journal's end
        if table is not None and not complete:
            table, t = table.replace_schema_metadata(), int(table["t_ns"][0].as_py())
            part = ParquetPart(folder, number)
            try:
                order = pc.sort_indices(table, sort_keys=[("asset", "ascending")])  # stable
                part.write(table.take(order), 0, t, t // DAY_NS)
                part.close()
            except BaseException:
                part.abandon()
                raise
        path.unlink()


def read_journal(path: Path, end: int | None = None) -> Any:
    """Return the rows of a journal, which may be written to at present, as a pyarrow.Table; None without any.

    With `end` its first bytes are read, to the end of a batch.
    """
    import pyarrow as pa

    batches = []
    try:
        with path.open("rb") as file, pa.ipc.open_stream(file) as stream:
            while end is None or file.tell() < end:
                batches.append(stream.read_next_batch())
    except (StopIteration, OSError, pa.ArrowInvalid):  # the end, or a batch that is not complete
        pass
    return pa.Table.from_batches(batches) if batches else None
