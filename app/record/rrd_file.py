"""Messages of .rrd files, parts of a split recording, and the space on its disk."""

from __future__ import annotations

import math
import re
import shutil
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from estimators.errors import ConfigError

MAGIC = b"RRF2"  # First bytes of an .rrd

STREAM_HEADER, MESSAGE_HEADER = 12, struct.Struct("<QQ")
"""Bytes before the first message of an .rrd; header of each message: its kind, and the number of bytes that follow."""

END_MESSAGE = 0  # Kind of the message that closes a stream

TAKEN = "is there already; choose another name, or remove it"  # Message about a path that is taken

RESERVED_BYTES = 32 * 2**20
"""Free bytes at which a recording ends: enough to close it, and for other programs."""

LOW_DISK_BYTES = 1e9  # Free bytes below which there is a warning, however slowly the file grows

LOW_DISK_S = 900.0
"""A file that will fill the disk in less time, at its growth so far, is warned of."""

GROWTH_SETTLING_S = 60.0
"""Age of a file from which its growth is used: a long history is written at once."""

SIZES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
TIMES = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
MIN_PART_BYTES, MIN_PART_S = 10**5, 1.0  # Size and duration below which a part would hold little but its header


def messages(file: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """Yield start, kind and end of each complete message in an .rrd of `size` bytes."""
    at = STREAM_HEADER
    while at + MESSAGE_HEADER.size <= size:
        file.seek(at)
        kind, length = MESSAGE_HEADER.unpack(file.read(MESSAGE_HEADER.size))
        end = at + MESSAGE_HEADER.size + length
        if end > size:
            return
        yield at, kind, end
        at = end


def complete_until(file: BinaryIO, size: int) -> tuple[int, bool]:
    """Return the end of the last complete message in a file of `size` bytes, and whether it closes the file."""
    end, closed = STREAM_HEADER, False
    for _, kind, after in messages(file, size):
        end, closed = after, kind == END_MESSAGE
        if closed:
            break
    return min(end, size), closed


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
    """A part ends at `size` bytes, after `seconds`, or with the day if `daily`, whichever comes first.

    Recordings of the same name are removed, oldest first, beyond `kept_bytes` in total and after `kept_seconds`.
    """

    size: float = math.inf
    seconds: float = math.inf
    daily: bool = False
    kept_bytes: float = math.inf
    kept_seconds: float = math.inf


NEVER = Split()

DAY = "day"  # Split at midnight

DATE = re.compile("%[YmdHMSj]")
"""Date in the name of a recording, as of strftime: local time."""


def parse_split(text: str | None, keep: str | None = None, option: str = "--record") -> Split:
    """Parse `1GB`, `10min` or `day`, or several of them, for example `1GB,day`; `keep` is a size, a duration or both.

    `option` begins the names of both options in messages.

    Raises:
        ConfigError: If one of them is wrong, or too small.
    """
    parts, kept = ([] if each is None else [part.strip() for part in each.split(",")] for each in (text, keep))
    each = [_parse_limit(f"{option}-split", part, f" or {DAY}") for part in parts if part != DAY]
    size, seconds = _least(each)
    return Split(size, seconds, DAY in parts, *_least([_parse_limit(f"{option}-keep", part) for part in kept]))


def _least(limits: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the smallest size and the shortest time."""
    size, seconds = (min(values) for values in zip(*limits, (math.inf, math.inf), strict=True))
    return size, seconds


def _parse_limit(option: str, text: str, more: str = "") -> tuple[float, float]:
    """Return a size in bytes and a duration in s, of which one is infinite."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-zA-Z]+)\s*", text)
    number, unit = (float(match[1]), match[2]) if match else (math.nan, "")
    size = next((bytes_ for name, bytes_ in SIZES.items() if name.lower() == unit.lower()), None)
    if size is not None and MIN_PART_BYTES <= number * size < math.inf:
        return number * size, math.inf
    if unit in TIMES and MIN_PART_S <= number * TIMES[unit] < math.inf:
        return math.inf, number * TIMES[unit]
    raise ConfigError(
        f"{option} {text}: must be a size of 100kB or more ({', '.join(SIZES)}) or a time of 1s or more "
        f"({', '.join(TIMES)}){more}, for example 1GB or 10min"
    )


def check_date(path: Path) -> None:
    """Reject a name with a `%` that is no part of a date.

    Raises:
        ConfigError: If there is one.
    """
    rest = DATE.sub("", str(path))
    if "%" in rest:
        raise ConfigError(f"--record {path}: {rest[rest.index('%') :][:2]} is no part of a date; use %Y %m %d %H %M %S")


def part_path(path: Path, number: int) -> tuple[Path, int]:
    """Return the path of a part and its number: the first at `path`, later ones numbered, skipping taken names.

    Each part of a path with a date has its own date, and a number if that is taken.
    """
    dated = Path(DATE.sub(lambda part: time.strftime(part[0]), str(path)))
    if dated != path:
        number = 1
    while True:
        part = dated if number == 1 else dated.with_name(f"{dated.stem}-{number}{dated.suffix}")
        if (number == 1 and dated == path) or not (part.is_symlink() or part.exists()):
            return part, number
        number += 1


def surplus_parts(path: Path, split: Split, writing: Path) -> list[Path]:
    """Return the recordings of the same name beyond the limits of a split, oldest first; `writing` is none of them."""
    if split.kept_bytes == split.kept_seconds == math.inf:
        return []
    absolute, depth = path.absolute(), 0
    folder = absolute.parent
    while DATE.search(str(folder)):
        folder, depth = folder.parent, depth + 1
    pieces = re.split(f"({DATE.pattern})", str(absolute.with_suffix("")))
    name = re.compile("".join(map(_digits, pieces)) + rf"(-\d+)?{re.escape(path.suffix)}")
    found = []
    for file in folder.glob("*/" * depth + f"*{path.suffix}"):
        if file != writing.absolute() and not file.is_symlink() and name.fullmatch(str(file)):
            with suppress(OSError):
                found.append((file.stat().st_mtime, file.stat().st_size, file))
    surplus, total = [], float(writing.stat().st_size if writing.exists() else 0)
    for written, size, file in sorted(found, reverse=True):
        total += size
        if total > split.kept_bytes or time.time() - written > split.kept_seconds:
            surplus.append(file)
    return surplus[::-1]


def _digits(piece: str) -> str:
    """Return the regular expression of a piece of a name."""
    widths = {"%Y": 4, "%j": 3}
    return rf"\d{{{widths.get(piece, 2)}}}" if DATE.fullmatch(piece) else re.escape(piece)
