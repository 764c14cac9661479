"""Source of CSV files that grow, and of tables that appear in a folder; each row is read once, as it comes."""

from __future__ import annotations

import os
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from estimators.errors import SourceError, nearest
from estimators.log import Events

from ..archives import is_compressed
from ..formats import suffix_of
from ..mapping import ABSENT, PRESENT
from ..source import NEVER, NO_ASSET, TRUNCATED, AssetEvents, Channel, Numbers, Report, Source, ignore
from .dialect import DETECTED, HEAD_BYTES, CsvFormat, Dialect, format_of
from .rows import TableRows, dated, is_text, names_of, rows_of
from .table import mapped
from .text import READ_AS, UNREADABLE, Column, TextCodes, chunk_of, column_of
from .times import TimeColumn, TimeReader

POLL_S = 0.1
"""Seconds between two looks for new rows."""

PIECE_BYTES = 2**18
"""Bytes read at once, and of the longest line."""

IDENTITY_BYTES = 256
"""First bytes by which a file is recognised; one that was written anew differs in them, or is shorter."""

LEFT_OUT = "file left out"
"""Key of files that are no tables of these columns."""

PARQUET_END = b"PAR1"
"""Last bytes of a complete Parquet file."""

_Batch = Events | AssetEvents


@dataclass
class _File:
    """A file and how far it was read: bytes and lines; `checked` first bytes have the CRC `head`.

    `rows` are those to come of a file that is no plain CSV.
    """

    inode: int
    offset: int = 0
    line: int = 0
    checked: int = 0
    head: int = 0
    seen: tuple[int, int] = (-1, -1)
    """Size and time of writing (ns) up to which nothing is left to read."""
    found: int = -1
    """Bytes that it had when it was found; when their rows came is not known."""
    format: CsvFormat | None = None
    times: TimeReader | None = None
    rows: Iterator[TableRows | None] | None = None

    def is_same(self, file: BinaryIO, size: int) -> bool:
        """Return whether a file of this inode still begins as it did."""
        file.seek(0)
        return size >= self.offset and zlib.crc32(file.read(self.checked)) == self.head


class FollowedTable(Source):
    """Reads the new rows of tables, in the order of their names: of plain CSV files as they are written.

    A file is known by its inode and first bytes, so one that is renamed is not read again, and one that is truncated or
    written anew is read from its start. A last line without a line end waits for it; a cell with a line break is not
    read. Parquet and other formats are read once they are complete. For rows and columns see `Table`.

    Args:
        files: Returns the present files in their order.
        time: The column that holds the time.
        channels: What feeds the model.
        width: Value columns of an event.
        report: Called for rows and files that cannot be used, with file and line.
        asset: The column with the name of each row's asset; `read` then returns `AssetEvents`.
        ends: Whether the files are complete: the source ends after their last row.
        dialect: How CSV files are written, as far as it is not detected.

    Raises:
        SourceError: If a present file lacks a column, or a unit does not convert.
    """

    waits = True

    def __init__(
        self,
        files: Callable[[], Sequence[Path]],
        *,
        time: TimeColumn,
        channels: Iterable[Channel],
        width: int,
        report: Report = ignore,
        asset: str | None = None,
        ends: bool = False,
        dialect: Dialect = DETECTED,
    ) -> None:
        channels = list(channels)
        self.live = not ends
        self._ends, self._asset, self._dialect = ends, asset, dialect
        self._list, self._time, self._width, self._report = files, time, width, report
        self._shift = round(time.shift * 1e9)
        self._columns, self._mapping = mapped(channels, width, report)
        self._read_columns: list[Column] = [*self._columns, *([] if asset is None else [TextCodes(asset)])]
        self._fed = {name: channel.name for channel in channels for name in channel.needed}
        self._valueless = set(range(len(self._columns)))
        nothing = Events.empty(width)
        self._nothing: _Batch = nothing if asset is None else AssetEvents(nothing, np.zeros(0, np.int64), ())
        self._files: dict[int, _File] = {}
        self._open: tuple[int, Path, BinaryIO] | None = None
        """Inode, path and handle of the file that was read last; if it was moved away, its rest is read from here."""
        self._stores, self._stored = False, dict[int, list[int]]()
        self._unstored: deque[tuple[int, int, list[int] | None]] = deque()
        """Mark, inode and position of what is not in `_stored` yet, by inode; None of a file that is gone."""
        self._closing = threading.Event()
        self.mark = 0
        """Pieces that were read."""
        whole = False
        for path in files():
            if _is_plain(path):
                with path.open("rb") as file:
                    self._format(path, file, None)
            elif not whole:  # the others when they are read: each takes a moment
                whole = True
                self._check(path, names_of(path, "", self._dialect))

    def numbers(self, mark: int) -> dict[str, list[int]]:
        """Return the positions after the first `mark` pieces, for `restore`."""
        while self._unstored and self._unstored[0][0] <= mark:
            _, inode, state = self._unstored.popleft()
            if state is None:
                self._stored.pop(inode, None)
            else:
                self._stored[inode] = state
        return {str(inode): state for inode, state in self._stored.items()}

    def restore(self, numbers: Numbers) -> None:
        """Continue at the `numbers` of the source before a restart, if any, and keep them from now on."""
        self._stores, self._stored = True, {int(inode): [*map(int, state)] for inode, state in numbers.items()}
        for inode, (offset, line, checked, head) in self._stored.items():
            self._files[inode] = _File(inode, offset, line, checked, head)

    def read(self, timeout: float) -> Any:
        """Return the events of the next rows; none after `timeout` seconds without one; None at the end."""
        events = self._next()
        if events is None and self._ends:
            for k in self._valueless if self.mark else ():
                name = self._columns[k]
                text = f"column {str(name)!r} has no value in any row, so {self._fed[name]} has no values"
                self._report(NEVER, text)
            self._valueless.clear()
            return None
        if events is None:
            self._closing.wait(min(timeout, POLL_S))
            events = self._next()
        return self._nothing if events is None else events

    def close(self) -> None:
        """Close the file that is open."""
        self._closing.set()
        self._close_open()
        for file in self._files.values():
            if file.rows is not None:
                file.rows.close()  # type: ignore[attr-defined]

    def _next(self) -> _Batch | None:
        """Return the events of the next piece of the first file that has one; None if there is none."""
        present: list[tuple[Path, os.stat_result]] = []
        try:
            paths = self._list()
        except OSError as error:
            self._report(LEFT_OUT, f"{error.filename}: it cannot be listed ({error.strerror}); check its permissions")
            return None
        for path in paths:
            with suppress(OSError):  # moved away meanwhile
                present.append((path, path.stat()))
        inodes = {stat.st_ino for _, stat in present}
        if self._open is not None and self._open[0] not in inodes:
            inode, path, handle = self._open
            with suppress(OSError, SourceError):
                events = self._piece(path, handle, self._files[inode])
                if events is not None:
                    return events
            self._close_open()
        for inode in [inode for inode in self._files if inode not in inodes]:
            del self._files[inode]
            self._note(inode, None)
        for path, stat in present:
            known = self._files.get(stat.st_ino)
            if known is not None and known.seen == (stat.st_size, stat.st_mtime_ns):
                continue
            try:
                events = self._of(path)
            except (OSError, SourceError) as error:
                cannot = f"{path}: it cannot be read ({error}); check its permissions"
                text = f"{error}; the file is left out" if isinstance(error, SourceError) else cannot
                self._report(LEFT_OUT, text)
                self._files.setdefault(stat.st_ino, _File(stat.st_ino)).seen = (stat.st_size, stat.st_mtime_ns)
                continue
            if events is not None:
                return events
        return None

    def _close_open(self) -> None:
        """Close the file that was read last."""
        if self._open is not None:
            self._open[2].close()
        self._open = None

    def _of(self, path: Path) -> _Batch | None:
        """Return the events of the next piece of a file; None if it has none."""
        handle = path.open("rb")
        try:
            stat = os.fstat(handle.fileno())
            known = self._files.get(stat.st_ino)
            if known is None or not known.is_same(handle, stat.st_size):
                known = self._files[stat.st_ino] = _File(stat.st_ino)
            if known.found < 0:
                known.found = stat.st_size
            events = self._piece(path, handle, known)
        except BaseException:
            handle.close()
            raise
        if events is None:
            known.seen = (stat.st_size, stat.st_mtime_ns)
        self._close_open()
        self._open = (stat.st_ino, path, handle)
        return events

    def _piece(self, path: Path, handle: BinaryIO, file: _File) -> _Batch | None:
        """Return the events of the next complete lines or rows; None if there are none."""
        if not _is_plain(path):
            return self._rows(path, handle, file)
        if file.offset < HEAD_BYTES or file.format is None:
            file.format = self._format(path, handle, file.format)
        handle.seek(file.offset)
        data = handle.read(PIECE_BYTES)
        end = data.rfind(b"\n") + 1
        cut = self._ends and end < len(data) < PIECE_BYTES  # a last line without a line end
        end = len(data) if cut else end
        if not end and len(data) == PIECE_BYTES:
            self._report(TRUNCATED, f"{path.name}:{file.line + 1}: the line is longer than {PIECE_BYTES} bytes")
            end = len(data)
        if not end or file.format is None:
            return None
        lines = data[:end].decode(file.format.encoding, "replace").split("\n")[: None if cut else -1]
        if file.times is None:
            file.times = TimeReader(self._time)
        came = None if self._ends or file.offset < file.found else time.time_ns()
        events = self._events(path, lines, file.line, file.format, file.times, came)
        self._advance(handle, file, file.offset + end, file.line + len(lines))
        return events

    def _rows(self, path: Path, handle: BinaryIO, file: _File) -> _Batch | None:
        """Return the events of the next rows of a file that is no plain CSV; None if there are none."""
        size = os.fstat(handle.fileno()).st_size
        if file.rows is None:
            if suffix_of(path) in (".parquet", ".pq") and not is_compressed(path) and not self._ends:
                handle.seek(max(0, size - len(PARQUET_END)))
                if handle.read() != PARQUET_END:
                    return None  # it is still being written
            self._check(path, names_of(path, "", self._dialect))
            file.rows = rows_of(path, self._time, self._read_columns, lambda: POLL_S, self._dialect)
        try:
            for found in file.rows:
                if found is None:
                    return self._nothing
                fresh = found.line > file.line
                found = found._replace(known=found.known & fresh)
                events = self._batch(path, found)
                if fresh.any():
                    self._advance(handle, file, 0, int(found.line[-1]))
                    return events
        except SourceError:
            file.rows = None
            raise
        file.rows = None
        self._advance(handle, file, size, file.line)
        return None

    def _advance(self, handle: BinaryIO, file: _File, offset: int, line: int) -> None:
        """Note how far a file was read."""
        file.offset, file.line = offset, line
        file.checked = min(offset or os.fstat(handle.fileno()).st_size, IDENTITY_BYTES)
        handle.seek(0)
        file.head = zlib.crc32(handle.read(file.checked))
        self.mark += 1
        self._note(file.inode, [file.offset, file.line, file.checked, file.head])

    def _note(self, inode: int, state: list[int] | None) -> None:
        if self._stores:
            self._unstored.append((self.mark, inode, state))

    def _format(self, path: Path, handle: BinaryIO, before: CsvFormat | None) -> CsvFormat | None:
        """Return the format of a file, None while its first row is not complete; `before` is that of its first rows.

        Raises:
            SourceError: If it is no CSV, or lacks a column.
        """
        handle.seek(0)
        head = handle.read(HEAD_BYTES)
        if b"\n" not in head:
            return None
        found = format_of(path, head[: head.rfind(b"\n") + 1], self._dialect)
        if before is not None and before.settled:  # More rows show the signs of numbers only.
            return before._replace(decimal=found.decimal, group=found.group, encoding=found.encoding)
        if found.encoding.startswith("utf-16"):
            raise SourceError(f"{path}: is UTF-16; only UTF-8 or Windows-1252 can be followed")
        self._check(path, found.names)
        if found.settled and found.remark:
            self._report(READ_AS, f"{path.name}: {found.remark}")
        return found

    def _check(self, path: Path, names: Sequence[str]) -> None:
        """Refuse a file that lacks a column, or has it twice.

        Raises:
            SourceError: Naming file and column.
        """
        for name in (*self._time.names, *map(column_of, self._read_columns)):
            if names.count(name) != 1:
                times = "no column" if name not in names else "more than one column"
                raise SourceError(f"{path}: there is {times} {name!r}; {nearest(name, names)}")

    def _events(
        self, path: Path, lines: list[str], before: int, kind: CsvFormat, times: TimeReader, came: int | None
    ) -> _Batch:
        """Return the events of the lines that follow so many lines of a file, and `came` at that time, ns."""
        rows, numbers = [], []
        problems: list[tuple[str, int, str]] = []
        for number, line in enumerate(lines, start=before + 1):
            cells: list[str] = next(kind.cells([line]), []) if number >= kind.first and line.strip() else []
            if not cells:
                continue
            if not kind.fits(cells) or line.count('"') % 2:
                text = f"has {len(cells)} cells, not {len(kind.names)}; the row is left out"
                problems.append((UNREADABLE, number, text))
                continue
            rows.append(cells)
            numbers.append(number)
        if not rows:
            found = None
        else:
            columns = self._read_columns
            chunk = chunk_of(rows, numbers, kind, self._time.names, columns, lambda *item: problems.append(item))
            found = dated(chunk, times, self._time, problems)
        for key, number, text in problems:
            self._report(key, f"{path.name}:{number}: {text}")
        return self._nothing if found is None else self._batch(path, found, came)

    def _batch(self, path: Path, found: TableRows, came: int | None = None) -> _Batch:
        """Return the events of rows, which `came` at that time, ns; None if it is not known, as of a recording."""
        for key, number, text in found.problems:
            self._report(key, f"{path.name}:{number}: {text}")
        t, known, width = found.t + self._shift, found.known, len(self._columns)
        values, blank = np.ascontiguousarray(found.values[:, :width]), found.blank[:, :width]
        if self._valueless:
            self._valueless -= set(np.flatnonzero(np.isfinite(values[known]).any(axis=0)).tolist())
        if self._asset is not None:
            nameless = found.blank[:, -1]
            for number in found.line[known & nameless]:
                text = f"{self._asset} is empty, so the row is of no asset and is left out"
                self._report(NO_ASSET, f"{path.name}:{number}: {text}")
            known = known & ~nameless
        state = np.where(blank, ABSENT, PRESENT).astype(np.int8)
        plan = np.zeros(t.size, np.int64)
        arrival = t if came is None else np.full(t.size, came)
        names = None
        if self._asset is not None:
            names = np.append(found.words, "")[np.where(known, found.values[:, -1], -1).astype(np.int64)]
        events, row = self._mapping.events(plan, t, arrival, values, state, (~known).astype(np.int8), names)
        if self._asset is None:
            return events
        return AssetEvents(events, found.values[row, -1].astype(np.int64), found.words)


def _is_plain(path: Path) -> bool:
    """Return whether a file is a CSV that can be read as it grows."""
    return is_text(path) and not is_compressed(path)
