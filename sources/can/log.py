"""Recorded CAN logs: BLF, ASC, TRC, candump, CSV and SQLite through python-can, MF4 through asammdf."""

from __future__ import annotations

import os
import sqlite3
import struct
import zlib
from collections.abc import Generator, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import can
from can.io.blf import BLFParseError

from estimators.errors import SourceError
from estimators.log import Readings

from ..source import Report, ignore
from .decoder import Decoder, Frames
from .mf4 import DamagedError, read_mf4
from .span import log_span

FIRST_CHUNK = 256
"""Frames read before the first events are given, so that they come at once."""

CHUNK = 8192

FORMATS = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc")

_UNREADABLE = (
    ValueError,
    IndexError,
    KeyError,
    TypeError,
    AssertionError,
    EOFError,
    OSError,
    StopIteration,
    struct.error,
    zlib.error,
    sqlite3.Error,
    can.CanError,
    BLFParseError,
    NotImplementedError,
)
"""What python-can's readers raise where a file is damaged or is not of the format that its name says."""


def _suffix(path: Path) -> str:
    name = path.name.lower().removesuffix(".gz")
    return os.path.splitext(name)[1]


class CanLog:
    """Reads log files one after the other, as one log.

    Args:
        files: Recordings in their order.
        decoder: What to take from their frames.
        report: Told of error frames and of files that are cut short.

    Raises:
        SourceError: If a file is missing, empty, or of no known format.
    """

    live = False

    def __init__(self, files: Sequence[str | os.PathLike[str]], decoder: Decoder, *, report: Report = ignore) -> None:
        self._files = [Path(file) for file in files]
        if not self._files:
            raise SourceError("CAN log: files is empty; name at least one recording")
        self._decoder = decoder
        self._report = report
        for path in self._files:
            self._check(path)
        self.frames = 0
        """Frames read so far, wanted or not."""
        self._batches = self._all()

    @cached_property
    def span(self) -> tuple[int, int] | None:
        """First and last time, ns; None where the format does not tell without being read."""
        return log_span(self._files)

    @staticmethod
    def _check(path: Path) -> None:
        """Refuse at once what could not be read later."""
        if not path.is_file():
            raise SourceError(f"{path}: there is no such file; check the path of the recording")
        if path.stat().st_size == 0:
            raise SourceError(f"{path}: the file is empty; record it again")
        if _suffix(path) not in FORMATS:
            raise SourceError(
                f"{path}: {path.suffix or 'a name without ending'} is no CAN log format; "
                f"choose from {', '.join(FORMATS)}"
            )
        if _suffix(path) == ".mf4":
            with path.open("rb") as file:
                if file.read(3) not in (b"MDF", b"UnF"):
                    raise SourceError(f"{path}: it cannot be read as MF4; check that it is one")
            return
        CanLog._open(path).stop()

    @staticmethod
    def _open(path: Path) -> Any:
        try:
            return can.LogReader(path)
        except _UNREADABLE as error:
            raise CanLog._bad(path, error) from None

    @staticmethod
    def _bad(path: Path, error: BaseException) -> SourceError:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        return SourceError(f"{path}: it cannot be read as {_suffix(path)[1:].upper()} ({reason}); check that it is one")

    def _all(self) -> Generator[Readings, None, None]:
        for path in self._files:
            if _suffix(path) == ".mf4":
                yield from self._mf4(path)
            else:
                yield from self._messages(path)

    def _mf4(self, path: Path) -> Generator[Readings, None, None]:
        try:
            recorded = read_mf4(path, self._decoder)
        except DamagedError as error:
            if path == self._files[0]:
                raise self._bad(path, error) from None
            self._cut(path, 0, str(error))
            return
        self.frames += recorded.total
        for _ in range(recorded.errors):
            self._report("error frame", f"{path.name}: error frame")
        for start in range(0, recorded.frames.plan.size, CHUNK):
            yield self._decoder.decode(Frames(*(column[start : start + CHUNK] for column in recorded.frames)))
        if recorded.fault:
            self._cut(path, recorded.total, recorded.fault)

    def _messages(self, path: Path) -> Generator[Readings, None, None]:
        reader = self._open(path)
        count = 0
        fault = ""
        try:
            messages = iter(reader)
            size = FIRST_CHUNK
            while True:
                chunk: list[Any] = []
                try:
                    # One by one into the list, so that what came before the fault is kept.
                    for message in islice(messages, size):
                        chunk.append(message)
                except _UNREADABLE as error:
                    fault = " ".join(str(error).split())[:160] or type(error).__name__
                count += len(chunk)
                self.frames += len(chunk)
                errors = sum(message.is_error_frame for message in chunk)
                for _ in range(errors):
                    self._report("error frame", f"{path.name}: error frame")
                batch = self._decoder.decode(self._decoder.gather(chunk, None))
                if len(batch):
                    yield batch
                if fault or len(chunk) < size:
                    break
                size = CHUNK
            fault = fault or self._missing_end(path, reader)
        finally:
            # SQLite lets only the thread that opened a file close it; else it is closed with its last reference.
            with suppress(sqlite3.ProgrammingError):
                reader.stop()
        if fault and not count:
            raise SourceError(
                f"{path}: it cannot be read as {_suffix(path)[1:].upper()} ({fault}); check that it is one"
            )
        if fault:
            self._cut(path, count, fault)

    @staticmethod
    def _missing_end(path: Path, reader: Any) -> str:
        """Why a file that was read without a fault is not whole, or nothing."""
        if isinstance(reader, can.BLFReader):
            size = path.stat().st_size
            return f"{size} of {reader.file_size} bytes are there" if reader.file_size > size else ""
        if path.suffix.lower() == ".db":
            # SQLite takes what a cut last page lacks for zeros, and gives rows of them without a word.
            with path.open("rb") as file:
                header = file.read(100)
            page, pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
            size, whole = path.stat().st_size, (65536 if page == 1 else page) * pages
            return f"{size} of {whole} bytes are there" if whole > size else ""
        if path.suffix.lower() in (".asc", ".csv", ".log", ".trc"):
            with path.open("rb") as file:
                file.seek(-1, os.SEEK_END)
                return "" if file.read(1) in (b"\n", b"\r") else "its last line has no end"
        return ""

    def _cut(self, path: Path, count: int, reason: str) -> None:
        self._report("truncated file", f"{path.name}: the file is damaged after {count} frames ({reason})")

    def read(self, timeout: float) -> Readings | None:
        """The events of the next frames; None at the end.

        Raises:
            SourceError: If a file turns out not to be what its name says.
        """
        return next(self._batches, None)

    def now(self) -> int | None:
        """A recording has no clock."""
        return None

    def close(self) -> None:
        """Close the file that is open."""
        self._batches.close()
