"""Parquet files of an archive: written under another name and renamed when complete; the oldest are removed."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from app.record.rrd_file import Disk, Split
from estimators.errors import SourceError
from sources.source import Report

GROUP_ROWS = 8192
"""Rows that are written at once; fewer only at the end of a file."""

OPEN = ".open"
"""Ending of the file that is being written."""

DAY_NS = 86_400 * 10**9


class ArchivePlan(NamedTuple):
    """Folder of one twin, whose name is the twin's in the archive, and the limits of files and folder."""

    folder: Path
    split: Split


def parts_of(folder: Path) -> list[Path]:
    """Return the complete files of a twin in the order of writing."""
    found = [path for path in folder.glob("*-*.parquet") if path.stem.rpartition("-")[2].isdigit()]
    return sorted(found, key=number_of)


def number_of(path: Path) -> int:
    """Return the number of a complete file."""
    return int(path.stem.rpartition("-")[2])


def remove_surplus(folder: Path, split: Split, report: Report) -> None:
    """Remove the oldest complete files beyond the size and age that are kept; the last one stays."""
    kept = 0.0
    for path in parts_of(folder)[::-1]:
        try:
            stat = path.stat()
            old = bool(kept) and (
                kept + stat.st_size > split.kept_bytes or time.time() - stat.st_mtime > split.kept_seconds
            )
            kept += stat.st_size
            if old:
                path.unlink()
        except OSError as error:
            report("kept archive", f"{path}: it cannot be removed ({error.strerror})")


class ParquetPart:
    """File that is being written."""

    def __init__(self, folder: Path, number: int | None = None) -> None:
        """Open it under a number that is not taken.

        Args:
            folder: Of the archive.
            number: Its number; None for the next one.

        Raises:
            OSError: If that is not possible.
            SourceError: If the disk is nearly full, or another process writes into the folder.
        """
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob(f"*{OPEN}"):
            with left.open("rb") as file:
                if not lock(file):
                    raise SourceError("another process writes into it; choose another folder")
            left.unlink(missing_ok=True)  # of a process that was killed
        if Disk(folder).free() < 0:
            raise SourceError("the disk is nearly full; free some space")
        self._number = number or max(map(number_of, parts_of(folder)), default=0) + 1
        self._path = folder / f"{self._number:06d}.parquet{OPEN}"
        self._file = self._path.open("xb")
        lock(self._file)
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
        self.writer.write_table(table, row_group_size=GROUP_ROWS)

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


def lock(file: IO[bytes]) -> bool:
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
