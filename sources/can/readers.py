"""Read the frames of a CAN log of any format as columns; runs in the process that reads the file."""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estimators.errors import SourceError

from ..formats import suffix_of
from ..units import second_ns

FIRST_CHUNK_FRAMES = 256  # Frames of the first chunk, so that it arrives at once
MAX_TIME_S = 2.0**62 / 1e9  # Distance of a valid time from 1970, s


def open_reader(path: Path) -> Any:
    """Open a file with the reader of python-can.

    Raises:
        SourceError: If it is not of the format of its name.
    """
    import can

    try:
        return can.LogReader(path)
    except Exception as error:  # noqa: BLE001  a damaged file makes python-can's readers raise anything
        raise unreadable(path, error) from None


def read_messages(path: Path, wanted: frozenset[int] | None, longest: int) -> Iterator[Raw | LogSummary]:
    """Yield the frames of a log that python-can reads, in their order, and at last its summary.

    Args:
        path: The log.
        wanted: Ids of the wanted frames, EXTENDED added; None is all.
        longest: Bytes of a frame to return.

    Raises:
        SourceError: If nothing can be read.
    """
    reader = open_reader(path)
    seen: Counter[tuple[BusName, int]] = Counter()
    buses: dict[BusName, int] = {}
    count = errors = broken = 0
    fault = ""
    try:
        messages = iter(reader)
        size = FIRST_CHUNK_FRAMES
        while True:
            chunk: list[Any] = []
            try:
                # One by one, so that frames before the fault are kept.
                for message in islice(messages, size):
                    chunk.append(message)
            except Exception as error:  # noqa: BLE001  as above
                fault = " ".join(str(error).split())[:160] or type(error).__name__
            count += len(chunk)
            errors += sum(message.is_error_frame for message in chunk)
            raw, lost = _columns(chunk, wanted, longest, buses, seen)
            broken += lost
            yield raw
            if fault or len(chunk) < size:
                break
            size = CHUNK_FRAMES
        fault = fault or _missing_end(path, reader)
        if broken:
            fault = fault or f"{broken} frames hold no numbers"
    finally:
        # SQLite lets only the opening thread close a file; otherwise it is closed with its last reference.
        with suppress(sqlite3.ProgrammingError):
            reader.stop()
    if fault and not count:
        raise unreadable(path, fault)
    yield LogSummary(dict(seen), errors, fault)


def _columns(
    messages: list[Any],
    wanted: frozenset[int] | None,
    longest: int,
    buses: dict[BusName, int],
    seen: Counter[tuple[BusName, int]],
) -> tuple[Raw, int]:
    """Return the messages of python-can as columns, and how many are damaged; error and remote frames have no data."""
    t, keys, places, length, chunks = [], [], [], [], []
    broken = 0
    for message in messages:
        if message.is_error_frame or message.is_remote_frame:
            continue
        try:
            # A damaged database holds other types.
            key = int(message.arbitration_id) & 0x1FFFFFFF
            if message.is_extended_id:
                key |= EXTENDED
            bus = message.channel
            seen[bus, key] += 1
            if wanted is not None and key not in wanted:
                continue
            if not abs(message.timestamp) <= MAX_TIME_S:
                raise ValueError("no time")
            time, data = second_ns(message.timestamp), bytes(message.data[:longest])
        except (TypeError, ValueError, OverflowError):
            broken += 1
            continue
        t.append(time)
        keys.append(key)
        places.append(buses.setdefault(bus, len(buses)))
        length.append(len(data))
        chunks.append(data.ljust(longest, b"\0"))
    raw = Raw(
        np.array(t, np.int64),
        np.array(keys, np.int64),
        np.array(places, np.int64),
        np.array(length, np.int64),
        np.frombuffer(bytearray().join(chunks), np.uint8).reshape(len(chunks), longest),
        tuple(buses),
        len(messages),
    )
    return raw, broken


def _missing_end(path: Path, reader: Any) -> str:
    """Return why a file that was read without a fault is incomplete, or an empty text."""
    import can

    if isinstance(reader, can.BLFReader):
        size = path.stat().st_size
        return f"{size} of {reader.file_size} bytes are there" if reader.file_size > size else ""
    if path.suffix.lower() == ".db":
        # SQLite silently reads the missing part of a cut last page as zeros.
        with path.open("rb") as file:
            header = file.read(100)
        page, pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
        size, whole = path.stat().st_size, (65536 if page == 1 else page) * pages
        return f"{size} of {whole} bytes are there" if whole > size else ""
    if path.suffix.lower() in (".asc", ".csv", ".log", ".trc"):
        with path.open("rb") as file:
            file.seek(-1, os.SEEK_END)
            return "" if file.read(1) in (b"\n", b"\r") else "its last line is incomplete"
    return ""


EXTENDED = 1 << 31
"""Added to the arbitration id of an extended frame, so that one number identifies it."""

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
    gist = " ".join(str(reason).split())[:160] or type(reason).__name__
    return SourceError(f"{path}: it cannot be read as {suffix_of(path)[1:].upper()} ({gist}); check that it is one")
