"""The file of a recording: written message by message, split into parts, and closed before the disk is full.

Rerun's own file sink keeps an entry for each column of each chunk in memory, some kilobytes a chunk; it follows links
and overwrites files; and it waits without a limit for a full disk. So the bytes are taken from the stream and written
here. A viewer reads a file without Rerun's footer from its start.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import rerun as rr

from estimators.errors import ConfigError

MAGIC = b"RRF2"
"""First bytes of an .rrd."""

STREAM_HEADER, MESSAGE_HEADER = 12, struct.Struct("<QQ")
"""Bytes before the first message of an .rrd; header of each message: its kind, and the number of bytes that follow."""

END_MESSAGE = 0
"""Kind of the message that closes a stream."""

FLUSH_TIMEOUT_S = 5.0

RESERVED_BYTES = 32 * 2**20
"""Free bytes at which a recording ends: enough to close it, and for other programs."""

LOW_DISK_BYTES = 1e9
"""Free bytes below which there is a warning, however slowly the file grows."""

LOW_DISK_S = 900.0
"""A file that will fill the disk in less time, at its growth so far, is warned of."""

GROWTH_SETTLING_S = 60.0
"""Age of a file from which its growth is used: a long history is written at once."""

SIZES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
TIMES = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
MIN_PART_BYTES, MIN_PART_S = 10**5, 1.0
"""Size and duration below which a part would hold little but its header."""


class RrdFile:
    """Writes the messages of a stream into a new file."""

    def __init__(self, path: Path, stream: rr.RecordingStream) -> None:
        """Create the file; the path must be free, also of a broken link.

        Raises:
            OSError: If it cannot be created, or the path is taken.
        """
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        self._stream = stream
        self._bytes = stream.binary_stream()
        self.size = 0

    def flush(self) -> None:
        """Hand the messages logged since to the operating system.

        Raises:
            OSError: If the file cannot grow; it then ends where it ended before.
        """
        data = self._bytes.read(flush_timeout_sec=FLUSH_TIMEOUT_S)
        if not data:
            return
        # Each piece is a stream of its own: the file keeps the header of the first, and no footer.
        end = next((at for at, kind, _ in messages(data) if kind == END_MESSAGE), len(data))
        self._write(data[STREAM_HEADER if self.size else 0 : end])

    def close(self) -> None:
        """Write the rest and the end message, and close the file also if that fails.

        Raises:
            OSError: As `flush`.
        """
        try:
            self.flush()
            self._write(MESSAGE_HEADER.pack(END_MESSAGE, 0))
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            self._stream.disconnect()

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._file, rest) :]
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._file, self.size)
                os.lseek(self._file, self.size, os.SEEK_SET)
            raise
        self.size += len(data)


def messages(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield start, kind and end of each complete message in the bytes of an .rrd."""
    at = STREAM_HEADER
    while at + MESSAGE_HEADER.size <= len(data):
        kind, length = MESSAGE_HEADER.unpack_from(data, at)
        end = at + MESSAGE_HEADER.size + length
        if end > len(data):
            return
        yield at, kind, end
        at = end


def complete_until(file: BinaryIO, size: int) -> tuple[int, bool]:
    """Return the end of the last complete message in a file of `size` bytes, and whether it closes the file."""
    end, kind = STREAM_HEADER, -1
    while kind != END_MESSAGE and end + MESSAGE_HEADER.size <= size:
        file.seek(end)
        kind_here, length = MESSAGE_HEADER.unpack(file.read(MESSAGE_HEADER.size))
        if end + MESSAGE_HEADER.size + length > size:
            break
        kind, end = kind_here, end + MESSAGE_HEADER.size + length
    return min(end, size), kind == END_MESSAGE


class Disk:
    """Free space for a growing file."""

    def __init__(self, folder: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._folder = folder
        self._clock = clock
        self._begun: tuple[float, int] | None = None
        self._warned = False

    def free(self) -> int:
        """Return the bytes that a file may still grow; negative when it must end."""
        return shutil.disk_usage(self._folder).free - RESERVED_BYTES

    def warning(self, size: int) -> str | None:
        """Return one line, once, when the disk is about to be filled by a file of `size` bytes."""
        now = self._clock()
        if self._begun is None:
            self._begun = (now, size)
        if self._warned:
            return None
        since, before = self._begun
        left = self.free()
        rate = (size - before) / (now - since) if now - since >= GROWTH_SETTLING_S else 0.0
        if left > LOW_DISK_BYTES and (rate <= 0.0 or left / rate > LOW_DISK_S):
            return None
        self._warned = True
        lasts = f", enough for about {left / rate / 60:.0f} min" if rate > 0.0 else ""
        return f"the disk of {self._folder.resolve()} has room for {left / 1e6:.0f} MB more{lasts}; free some, or stop"


@dataclass(frozen=True)
class Split:
    """A part ends at `size` bytes or after `seconds`, whichever comes first."""

    size: float = math.inf
    seconds: float = math.inf


NEVER = Split()


def parse_split(text: str) -> Split:
    """Parse `1GB` or `10min`.

    Raises:
        ConfigError: If it is neither a size nor a duration, or too small.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-zA-Z]+)\s*", text)
    number, unit = (float(match[1]), match[2]) if match else (math.nan, "")
    size = next((bytes_ for name, bytes_ in SIZES.items() if name.lower() == unit.lower()), None)
    if size is not None and MIN_PART_BYTES <= number * size < math.inf:
        return Split(size=number * size)
    if unit in TIMES and MIN_PART_S <= number * TIMES[unit] < math.inf:
        return Split(seconds=number * TIMES[unit])
    raise ConfigError(
        f"--record-split {text}: must be a size of 100kB or more ({', '.join(SIZES)}) or a time of 1s or more "
        f"({', '.join(TIMES)}), for example 1GB or 10min"
    )


def part_path(path: Path, number: int) -> tuple[Path, int]:
    """Return the path of a part and its number: the first at `path`, later ones numbered, skipping taken names."""
    while True:
        part = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        if number == 1 or not (part.is_symlink() or part.exists()):
            return part, number
        number += 1
