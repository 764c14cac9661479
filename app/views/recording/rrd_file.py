"""Into parts of which size or time a recording is split."""

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

SIZES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
TIMES = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
LEAST_SIZE, LEAST_TIME = 10**5, 1.0
"""Bytes and seconds below which a part would hold little else than what each of them says of its twin."""


@dataclass(frozen=True)
class Split:
    """A part ends when it has taken `size` bytes, or `seconds` after it began, whichever comes first."""

    size: float = math.inf
    seconds: float = math.inf


NEVER = Split()


def parse_split(text: str) -> Split:
    """What `1GB` or `10min` stands for.

    Raises:
        ConfigError: If it is neither a size nor a time, or too little.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-zA-Z]+)\s*", text)
    number, unit = (float(match[1]), match[2]) if match else (math.nan, "")
    size = next((bytes_ for name, bytes_ in SIZES.items() if name.lower() == unit.lower()), None)
    if size is not None and LEAST_SIZE <= number * size < math.inf:
        return Split(size=number * size)
    if unit in TIMES and LEAST_TIME <= number * TIMES[unit] < math.inf:
        return Split(seconds=number * TIMES[unit])
    raise ConfigError(
        f"--record-split {text}: must be a size of 100kB or more ({', '.join(SIZES)}) or a time of 1s or more "
        f"({', '.join(TIMES)}), for example 1GB or 10min"
    )


def part_path(path: Path, number: int) -> tuple[Path, int]:
    """Where a part goes: the first to `path`, the others beside it, numbered; a name that is taken is passed over.

    Returns:
        The path, and the number that it has.
    """
    while True:
        part = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        if number == 1 or not (part.is_symlink() or part.exists()):
            return part, number
        number += 1


RESERVE = 32 * 2**20
"""Free bytes at which a recording ends: what closes it still fits, and others find room."""

LOW = 1e9
"""Free bytes below which there is a warning, however slowly the file grows."""

AHEAD = 900.0
"""Seconds: a file that would fill the disk sooner, at the rate at which it has grown so far, is warned of."""

SETTLED = 60.0
"""Seconds of growth after which that rate says something: a long history is written at once."""


class Disk:
    """Watches the room that a growing file has left."""

    def __init__(self, folder: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._folder = folder
        self._clock = clock
        self._begun: tuple[float, int] | None = None
        self._warned = False

    def free(self) -> int:
        """Bytes that a file may still take before it has to end; less than 0 when it is time."""
        return shutil.disk_usage(self._folder).free - RESERVE

    def warning(self, size: int) -> str | None:
        """One line, once, when the room will soon be used up by a file that has `size` bytes now."""
        now = self._clock()
        if self._begun is None:
            self._begun = (now, size)
        if self._warned:
            return None
        since, before = self._begun
        left = self.free()
        rate = (size - before) / (now - since) if now - since >= SETTLED else 0.0
        if left > LOW and (rate <= 0.0 or left / rate > AHEAD):
            return None
        self._warned = True
        lasts = f", which lasts for about {left / rate / 60:.0f} min" if rate > 0.0 else ""
        return f"the disk of {self._folder.resolve()} has room for {left / 1e6:.0f} MB more{lasts}; make room, or stop"


STREAM_HEADER, MESSAGE_HEADER = 12, struct.Struct("<QQ")
"""Bytes before the first message of an .rrd; and before each: its kind, and how many bytes follow."""

END = 0
"""The kind of the message that closes a stream."""

BEGIN = b"RRF2"
"""What an .rrd begins with."""

PATIENCE = 5.0
"""Seconds for Rerun to hand over what was logged."""


class RrdFile:
    """Writes what a stream logs into a new file."""

    def __init__(self, path: Path, stream: rr.RecordingStream) -> None:
        """Make the file, under a name that nothing stands under yet: not even a link that leads nowhere.

        Raises:
            OSError: If it cannot be made, or the name is taken.
        """
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        self._stream = stream
        self._bytes = stream.binary_stream()
        self.size = 0

    def flush(self) -> None:
        """Hand to the operating system what was logged since.

        Raises:
            OSError: If the file takes no more; it then ends where it ended before.
        """
        data = self._bytes.read(flush_timeout_sec=PATIENCE)
        if not data:
            return
        # Each piece is a stream of its own, with a header and a footer that hold for the first and for none.
        end = next((at for at, kind, _ in messages(data) if kind == END), len(data))
        self._write(data[STREAM_HEADER if self.size else 0 : end])

    def close(self) -> None:
        """Write what is left and the end; the file is closed also if it does not take them.

        Raises:
            OSError: As `flush`.
        """
        try:
            self.flush()
            self._write(MESSAGE_HEADER.pack(END, 0))
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Let go of the file as it is."""
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
    """Where each message of an .rrd's bytes begins, its kind, and where it ends; those that are there in full."""
    at = STREAM_HEADER
    while at + MESSAGE_HEADER.size <= len(data):
        kind, length = MESSAGE_HEADER.unpack_from(data, at)
        end = at + MESSAGE_HEADER.size + length
        if end > len(data):
            return
        yield at, kind, end
        at = end


def whole_until(file: BinaryIO, size: int) -> tuple[int, bool]:
    """Where the last message that is there in full ends, in a file of `size` bytes; and whether it closes the file."""
    end, kind = STREAM_HEADER, -1
    while kind != END and end + MESSAGE_HEADER.size <= size:
        file.seek(end)
        kind_here, length = MESSAGE_HEADER.unpack(file.read(MESSAGE_HEADER.size))
        if end + MESSAGE_HEADER.size + length > size:
            break
        kind, end = kind_here, end + MESSAGE_HEADER.size + length
    return min(end, size), kind == END
