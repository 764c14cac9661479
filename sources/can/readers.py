"""Read the frames of a CAN log of any format as columns; runs in the process that reads the file."""

from __future__ import annotations

import logging
import re
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from io import TextIOWrapper
from pathlib import Path
from typing import NamedTuple, TypeVar

import can
import numpy as np
from can.io import asc, blf

from estimators.errors import SourceError

from ..formats import suffix_of
from ..units import second_ns
from ..worker_process import gist
from .text_logs import open_text_log

FIRST_CHUNK_FRAMES = 256  # Frames of the first chunk, so that it arrives at once
MAX_TIME_S = 2.0**62 / 1e9  # Distance of a valid time from 1970, s
MAX_BAD_LINES = 100  # Lines of a text log that cannot be read, one after the other, after which the rest is left


def open_reader(path: Path, zone: str | None = None) -> can.io.MessageReader:
    """Open a file with a reader of python-can, or one like it; `zone` is the time zone of its dates, None is UTC.

    Raises:
        SourceError: If it is not of the format of its name, or its times cannot be used.
    """
    try:
        return open_text_log(path, zone) or can.LogReader(path)
    except SourceError:
        raise
    except Exception as error:  # noqa: BLE001  a damaged file makes python-can's readers raise anything
        raise unreadable(path, error) from None


def read_messages(
    path: Path, wanted: frozenset[int] | None, longest: int, zone: str | None = None
) -> Iterator[Raw | LogSummary]:
    """Yield the frames of a log that python-can reads, in their order, and at last its summary.

    Args:
        path: The log.
        wanted: Ids of the wanted frames, EXTENDED added, or their parameter groups (`group_of`); None is all.
        longest: Bytes of a frame to return.
        zone: Time zone of the dates of a text log; None is UTC.

    Raises:
        SourceError: If nothing can be read.
    """
    from .blf import BlfBlocks

    _correct_readers()
    warned = _Warnings()
    logging.getLogger("can").handlers = [warned]
    reader = open_reader(path, zone)
    if isinstance(reader, can.BLFReader):
        reader.__class__ = BlfBlocks
    lines = _Lines(reader.file) if isinstance(getattr(reader, "file", None), TextIOWrapper) else None
    if lines:
        reader.file = lines
    columns = Columns(wanted, longest)
    size, chunk = FIRST_CHUNK_FRAMES, list[can.Message]()
    fault = ""
    try:
        try:
            for item in _by_lines(path, reader, lines) if lines else reader:
                if isinstance(item, tuple):
                    if chunk:
                        yield columns.of_messages(chunk)
                    yield columns.of_block(Raw(*item))
                    chunk = []
                    continue
                chunk.append(item)
                if len(chunk) == size:
                    yield columns.of_messages(chunk)
                    size, chunk = CHUNK_FRAMES, []
        except SourceError:
            raise
        except Exception as error:  # noqa: BLE001  as above; frames before the fault are kept
            fault = f"{gist(error)} after frame {columns.total + len(chunk)}"
        yield columns.of_messages(chunk)
        if bad := getattr(reader, "bad", ()):
            fault = refused("", len(bad), "block", *bad[0])
        fault = fault or getattr(lines, "fault", "") or warned.fault or _missing_end(path, reader, lines)
        if columns.broken:
            fault = fault or f"{columns.broken} frames hold no numbers"
    finally:
        # SQLite lets only the opening thread close a file; otherwise it is closed with its last reference.
        with suppress(sqlite3.ProgrammingError):
            reader.stop()
    if fault and not columns.total:
        raise unreadable(path, fault)
    yield LogSummary(dict(columns.seen), columns.errors, fault)


def _correct_readers() -> None:
    """Correct faults of python-can's readers, in this process.

    Times before the start of a BLF log are negative, but are read as unsigned (hardbyte/python-can#2101). A CAN FD
    frame of which a BLF log holds fewer bytes than it counts is filled with zeros, or with the next frame
    (hardbyte/python-can#1905). Lines of an ASC log before its start are skipped (hardbyte/python-can#1595).
    """
    blf.OBJ_HEADER_V1_STRUCT = struct.Struct("<LHHq")
    blf.OBJ_HEADER_V2_STRUCT = struct.Struct("<LBxHq8x")
    if isinstance(blf.CAN_FD_MSG_STRUCT, struct.Struct):
        blf.CAN_FD_MSG_STRUCT = _StoredBytes(blf.CAN_FD_MSG_STRUCT, 20, 7, None)  # type: ignore[misc, assignment]
        blf.CAN_FD_MSG_64_STRUCT = _StoredBytes(  # type: ignore[misc, assignment]
            blf.CAN_FD_MSG_64_STRUCT, blf.CAN_FD_MSG_64_STRUCT.size, 2, 13
        )
    asc.ASC_MESSAGE_REGEX = re.compile(  # type: ignore[misc]
        r"-?\d+\.\d+\s+(\d+\s+(\w+\s+(Tx|Rx)|ErrorFrame)|CANFD)", re.ASCII | re.IGNORECASE
    )


class _StoredBytes:
    """Layout of a CAN FD object of a BLF log, whose count of bytes is limited to those that the object holds.

    Args:
        layout: python-can's own.
        head: Bytes of the object between its header and the data.
        count: Place of the count of bytes among the fields.
        end: Place of the field that gives the end of the data; None if there is none, 0 is the end of the object.
    """

    def __init__(self, layout: struct.Struct, head: int, count: int, end: int | None) -> None:
        self.size, self.pack = layout.size, layout.pack
        self._layout, self._head, self._count, self._end = layout, head, count, end

    def unpack_from(self, data: bytes, at: int) -> tuple[object, ...]:
        """Return the fields of an object whose header ends at a place."""
        fields = list(self._layout.unpack(data[at : at + self.size].ljust(self.size, b"\0")))
        header = 32 if data[at - 32 : at - 28] == b"LOBJ" else 40
        *_, size, _ = blf.OBJ_HEADER_BASE_STRUCT.unpack_from(data, at - header)
        stored = (fields[self._end] if self._end is not None else 0) or size
        fields[self._count] = min(fields[self._count], max(0, stored - header - self._head))
        return tuple(fields)


class _Lines:
    """Lines of a text log, which can be read on after one that python-can cannot read.

    python-can's readers begin with the header each time, for which `refuse` adds an empty line.
    """

    def __init__(self, file: TextIOWrapper) -> None:
        file.reconfigure(encoding="utf-8", errors="replace")  # comments may have any encoding
        self._file, self.line = file, ""
        self._pending: list[str] = []
        self._number = self._bad = 0  # Number of the last line, and lines that could not be read
        self.fault, self.whole = "", False
        """What could not be read, and whether the last frame has all of its bytes."""

    @property
    def incomplete(self) -> bool:
        """Whether the last line has no end."""
        return self.line[-1:] not in ("", "\n")

    def __iter__(self) -> _Lines:
        return self

    def __next__(self) -> str:
        if self._pending:
            return self._pending.pop()
        for line in self._file:
            self._number, self.line = self._number + 1, line
            if not (zeros := line.count("\0")):  # python-can skips such a line, or reads what is left of it
                return line
            self.refuse(f"{zeros} of its bytes are zero")
            self._pending.clear()
        raise StopIteration

    def repeat(self) -> None:
        """Give the last line once more."""
        if self.line:
            self._pending.append(self.line)

    def refuse(self, error: object) -> None:
        """Count the last line as unreadable."""
        self._bad += 1
        self._pending.append("\n")
        self.fault = refused(self.fault, self._bad, "line", f"line {self._number}", error)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def refused(before: str, count: int, what: str, place: str, error: object) -> str:
    """Return the fault of a file of which so many lines or blocks cannot be read, this one last; `before` it was."""
    first = before.partition(", the first")[2] or f" {place}: {gist(error)}"
    return f"{count} {what}{'s' if count > 1 else ''} cannot be read, the first{first}"


def _by_lines(path: Path, reader: can.io.MessageReader, lines: _Lines) -> Iterator[can.Message]:
    """Yield the messages of a text log; a line that cannot be read is counted and skipped.

    Raises:
        SourceError: If the times cannot be used.
    """
    in_a_row = 0
    while in_a_row < MAX_BAD_LINES:
        try:
            for message in reader:
                if getattr(reader, "timestamps_format", None) == "relative":
                    raise SourceError(
                        f"{path}: its times count from one event to the next (timestamps relative); export it with "
                        "absolute times"
                    )
                if suffix_of(path) == ".log" and len(message.data) > message.dlc:
                    lines.refuse("it ends within a byte")
                    continue
                in_a_row, lines.whole = 0, len(message.data) == message.dlc
                yield message
            return
        except (SourceError, EOFError, OSError, zlib.error):  # The others are of an archive that is cut or damaged.
            raise
        except Exception as error:  # noqa: BLE001  as above
            lines.refuse(error)
            in_a_row += 1
    lines.fault += f"; {MAX_BAD_LINES} in a row, so the rest is left out"


class _Warnings(logging.Handler):
    """Warnings of python-can's readers, of parts that they skip; they would fill the terminal."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._count, self._first = 0, ""

    def emit(self, record: logging.LogRecord) -> None:
        """Count a warning; the ASC reader's are of frames that it reads, and an empty line is one of `_Lines`."""
        if record.name != "can.io.asc" and record.args != ("",):
            self._first = self._first or " ".join(record.getMessage().split())[:120]
            self._count += 1

    @property
    def fault(self) -> str:
        """The first warning, and how many there were; empty if there was none."""
        return f"{self._count} × {self._first}" if self._count > 1 else self._first


class Columns:
    """Frames of a log as columns, the wanted ones; all of them are counted. Arguments as those of `read_messages`."""

    def __init__(self, wanted: frozenset[int] | None, longest: int) -> None:
        self._wanted, self._longest = wanted, longest
        self._buses: dict[BusName, int] = {}
        self.seen: Counter[tuple[BusName, int]] = Counter()
        """Data frames so far, by bus and id."""
        self.total = self.errors = self.broken = 0
        """All frames so far; error frames, and frames that hold no numbers, among them."""

    def of_messages(self, messages: list[can.Message]) -> Raw:
        """Return messages of python-can; error and remote frames have no data and are left out."""
        t, keys, places, length, chunks = [], [], [], [], []
        wanted, longest = self._wanted, self._longest
        self.total += len(messages)
        for message in messages:
            self.errors += message.is_error_frame
            if message.is_error_frame or message.is_remote_frame:
                continue
            try:
                # A damaged database holds other types.
                key = int(message.arbitration_id) & 0x1FFFFFFF
                if message.is_extended_id:
                    key |= EXTENDED
                bus = message.channel
                self.seen[bus, key] += 1
                if wanted is not None and key not in wanted and group_of(key) not in wanted:
                    continue
                if not abs(message.timestamp) <= MAX_TIME_S:
                    raise ValueError("no time")
                time, data = second_ns(message.timestamp), bytes(message.data[:longest])
            except (TypeError, ValueError, OverflowError):
                self.broken += 1
                continue
            t.append(time)
            keys.append(key)
            places.append(self._buses.setdefault(bus, len(self._buses)))
            length.append(len(data))
            chunks.append(data.ljust(longest, b"\0"))
        numbers = (np.array(column, np.int64) for column in (t, keys, places, length))
        rows = np.frombuffer(bytearray().join(chunks), np.uint8).reshape(len(chunks), longest)
        return Raw._make((*numbers, rows, tuple(self._buses), len(messages)))

    def of_block(self, block: Raw) -> Raw:
        """Return frames of a block with numbers of buses in place of positions."""
        self.total += block.total
        codes, counts = np.unique((block.bus << 32) + block.key, return_counts=True)
        for code, count in zip(codes.tolist(), counts.tolist(), strict=True):
            self.seen[code >> 32, code & 0xFFFFFFFF] += count
        rows = wanted_rows(block.key, self._wanted)
        numbers, inverse = np.unique(block.bus[rows], return_inverse=True)
        places = [self._buses.setdefault(number, len(self._buses)) for number in numbers.tolist()]
        data = np.zeros((rows.size, self._longest), np.uint8)
        data[:, :8] = block.data[rows, : self._longest]
        length = np.minimum(block.length[rows], self._longest)
        bus = np.array(places, np.int64)[inverse]
        return Raw(block.t[rows], block.key[rows], bus, length, data, tuple(self._buses), block.total)


def _missing_end(path: Path, reader: can.io.MessageReader, lines: _Lines | None) -> str:
    """Return why a file that was read without a fault is incomplete, or an empty text."""
    if isinstance(reader, can.BLFReader):
        size = path.stat().st_size
        if reader.file_size > size:
            return f"{size} of {reader.file_size} bytes are there"
        return "its last frame is incomplete" if reader._tail.strip(b"\0") else ""
    if path.suffix.lower() == ".db":
        # SQLite silently reads the missing part of a cut last page as zeros.
        with path.open("rb") as file:
            header = file.read(100)
        page, pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
        size, whole = path.stat().st_size, (65536 if page == 1 else page) * pages
        return f"{size} of {whole} bytes are there" if whole > size else ""
    if isinstance(reader, can.TRCReader) and lines and lines.whole and re.search(r"\s\w\w\s*$", lines.line):
        return ""  # with all of its bytes, the last one of two digits
    return "its last line is incomplete" if lines and lines.incomplete else ""


EXTENDED = 1 << 31
"""Added to the arbitration id of an extended frame, so that one number identifies it."""

GROUP = 1 << 30
"""Added to a parameter group of J1939 in place of an id: priority and addresses are zero."""

Ids = TypeVar("Ids", int, np.ndarray)
"""An id, or several."""


def group_bits(key: Ids) -> Ids:
    """Return the bits of an id that name its parameter group; below format 240 the next byte is an address."""
    return 0x3FF0000 | 0xFF00 * (key >> 16 & 0xFF >= 240)


def group_of(key: Ids) -> Ids:
    """Return the parameter group of an id with EXTENDED; of any other id a number that no wanted one has."""
    return key & (EXTENDED | group_bits(key)) | GROUP


def wanted_rows(key: np.ndarray, wanted: frozenset[int] | None) -> np.ndarray:
    """Return the places of the ids (n,) that are wanted, by themselves or by their parameter group; None is all."""
    if wanted is None:
        return np.arange(key.size)
    listed = list(wanted)
    found = np.isin(key, listed)
    if any(item & GROUP for item in listed):
        found |= np.isin(group_of(key), listed)
    return np.flatnonzero(found)


CHUNK_FRAMES = 8192  # Frames of a chunk

BusName = int | str | None


class Raw(NamedTuple):
    """Frames of a log, not decoded.

    Columns of one length n: times (ns), ids (EXTENDED added to extended ones), positions of their buses in `buses`,
    lengths, and bytes (n, longest). `total` counts all frames read for them, wanted or not.
    """

    t: np.ndarray
    key: np.ndarray
    bus: np.ndarray
    length: np.ndarray
    data: np.ndarray
    buses: tuple[BusName, ...]
    total: int


class LogSummary(NamedTuple):
    """Summary after a file's last frames: data frames by bus and id, error frames, and damage."""

    seen: dict[tuple[BusName, int], int]
    errors: int
    fault: str


def unreadable(path: Path, reason: object) -> SourceError:
    """Return the error of a file of which nothing can be read."""
    kind = suffix_of(path)[1:].upper()
    return SourceError(f"{path}: it cannot be read as {kind} ({gist(reason)}); check that it is one")
