"""Text logs that python-can reads wrongly or not at all.

These are ASC, CSV files of GVRET (SavvyCAN) and of CANedge (mdf2csv), and the console output of candump.

Source: output of can-utils' candump.c and of SavvyCAN's framefileio.cpp; logs of CANoe in public code.
"""

from __future__ import annotations

import gzip
import logging
import re
from collections.abc import Callable, Generator, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO
from zoneinfo import ZoneInfo

import can
import numpy as np
from can.io.generic import TextIOMessageReader

from estimators.errors import SourceError

from ..archives import open_binary
from ..dates import ns_of_date, ns_of_iso
from ..formats import suffix_of

HEAD_BYTES = 65_536  # Bytes from which the form of a log is detected
DATED_S = 1e8  # Times from here on count from 1970
MIN_DIFFERENCES, MAX_RISE = 4, 0.5  # Frames, and rise of their times as a share of all steps, of differences
MIN_TIMES, MIN_RISE = 8, 0.9  # The same of times from the first frame

GVRET = ("time stamp", "id", "extended", "bus", "len", "d1")
CANEDGE = ("timestampepoch", "id", "ide", "buschannel", "datalength", "databytes")
"""Columns that are read: time, id, whether it is extended, bus, number of bytes, and the first or all of the bytes."""

CONSOLE = re.compile(
    r"\s*(?:\((?P<time>\d+\.\d+|\d+-[-\d:. ]+)\)\s+)?(?P<bus>\S+)\s+(?:[RT]X\s+\S\s+\S\s+)?"
    r"(?P<id>[0-9A-F]{3}|[0-9A-F]{8})\s+\[(?P<size>\d+)\](?P<data>.*)",
    re.IGNORECASE,
)
"""A line of candump's console output, with the flags of its option -x."""

FD_LINE = re.compile(
    r"(\d+\s+[RT]x\S*\s+[0-9A-F]+x?)\s+(?:\S.*?\s+)??([01]\s+[01])\s+([0-9A-F])\s+(\d+)((?:\s+[0-9A-F]{1,3}\b)*)",
    re.IGNORECASE,
)
"""A CAN FD frame of an ASC log: channel, direction and id; symbolic name; flags, DLC, length and data."""

log = logging.getLogger("can.text_logs")  # One of python-can's, whose warnings become the fault of a file


def is_frames(path: Path) -> bool:
    """Return whether a file that ends as a table does (.csv, .txt) is a log of frames, by its first lines."""
    try:
        return _form(_head(path)) is not None
    except OSError:
        return False  # It is reported when the file is read.


def open_text_log(path: Path, zone: str | None) -> TextIOMessageReader | None:
    """Open a log that this module reads; None leaves it to python-can.

    Args:
        path: The log.
        zone: Time zone of its dates; None is UTC.

    Raises:
        SourceError: If its times cannot be used.
    """
    kind = suffix_of(path)
    lines = _head(path) if kind in (".csv", ".log", ".txt") else []
    form = _form(lines)
    if lines and "***BUSMASTER" in lines[0]:
        raise SourceError(f"{path}: is a log of BUSMASTER; convert it to ASC there (Format Converters, Log to ASC)")
    if kind != ".asc" and form in (None, can.CSVReader):
        return None
    file: TextIO = gzip.open(path, "rt") if path.suffix.lower() == ".gz" else path.open()  # type: ignore[assignment]
    if kind == ".asc":
        return AscLog(file, zone)
    return TextLog(file, ColumnLines(lines[0]) if form is ColumnLines else CandumpLines(path, lines, zone))


def _head(path: Path) -> list[str]:
    with open_binary(path) as file:
        head = file.read(HEAD_BYTES)
    lines = head.decode("utf-8-sig", "replace").splitlines()
    return [line for line in (lines[:-1] if len(head) == HEAD_BYTES else lines) if line.strip()]


def _form(lines: list[str]) -> type | None:
    """Return the class that reads lines which begin with these, if it is known."""
    names = _cells(lines[0]) if lines else []
    if names[:2] == ["timestamp", "arbitration_id"]:
        return can.CSVReader
    if set(GVRET) <= set(names) or set(CANEDGE) <= set(names):
        return ColumnLines
    return CandumpLines if any(CONSOLE.fullmatch(_plain(line)) for line in lines[:5]) else None


def _delimiter(line: str) -> str:
    return max(",;\t", key=line.count)


def _cells(line: str) -> list[str]:
    return [cell.strip(' "').lower() for cell in line.strip().split(_delimiter(line))]


def _plain(line: str) -> str:
    """Return a line of a terminal without its colours."""
    return re.sub(r"\x1b\[[0-9;]*m", "", line).rstrip() if "\x1b" in line else line.rstrip()


def _stamp(zone: str | None, t: int) -> float:
    """Return the seconds since 1970 of a local time, ns; a zone that is None is UTC."""
    known = datetime.strptime(zone, "%z").tzinfo if zone and zone[0] in "+-" else zone and ZoneInfo(zone)
    return datetime.fromtimestamp(t // 10**9, UTC).replace(tzinfo=known or UTC).timestamp() + t % 10**9 * 1e-9


class TextLog(TextIOMessageReader):
    """Reader of a log with a frame a line, as those of python-can; `parse` returns the frame, None if there is none."""

    def __init__(self, file: TextIO, parse: Callable[[str], can.Message | None]) -> None:
        super().__init__(file)
        self._parse = parse

    def __iter__(self) -> Iterator[can.Message]:
        return filter(None, map(self._parse, self.file))


def _frame(
    time: float, key: str, extended: bool, bus: int | str, size: int, data: bytes, remote: bool, error: bool = False
) -> can.Message:
    if len(data) != size and not remote:
        raise ValueError(f"it has {len(data)} of {size} bytes")
    number = int(key, 16) & 0x1FFFFFFF
    return can.Message(time, number, extended, remote, error, bus, data=data, is_fd=size > 8)


class ColumnLines:
    """Lines of a CSV of GVRET (times in µs, a column for each byte) or CANedge (times in s, the bytes as one text)."""

    def __init__(self, heading: str) -> None:
        self._heading, self._delimiter = heading.strip(), _delimiter(heading)
        place = {name: k for k, name in enumerate(_cells(heading))}
        self._gvret = set(GVRET) <= set(place)
        self._places = [place[name] for name in (GVRET if self._gvret else CANEDGE)]
        self._remote = place.get("rtr")

    def __call__(self, line: str) -> can.Message | None:
        """Return the frame of a line; None if it is blank or the heading."""
        line = line.strip().removeprefix("\ufeff")
        if not line or line == self._heading:
            return None
        cells = line.split(self._delimiter)
        time, key, extended, bus, count, first = self._places
        size, long = int(cells[count]), cells[extended].lower() in ("true", "1")
        t = int(cells[time]) / 1e6 if self._gvret else float(cells[time])
        data = bytes.fromhex(" ".join(cells[first : first + size]) if self._gvret else cells[first])
        remote = self._remote is not None and cells[self._remote] == "1"
        return _frame(t, cells[key], long, int(cells[bus]), size, data, remote)


class CandumpLines:
    """Lines of candump's console output, with the times of its options -ta, -tA, -tz or -td.

    Raises:
        SourceError: If the lines have no times, or it is not known from where these count.
    """

    def __init__(self, path: Path, lines: list[str], zone: str | None) -> None:
        every = [match["time"] for line in lines if (match := CONSOLE.fullmatch(_plain(line)))]
        self._zone, self._sums, self._t = zone, False, 0.0
        remedy = "record with candump -L"
        if 2 * len(found := [text for text in every if text]) < len(every):  # A line that is damaged may have none.
            raise SourceError(f"{path}: it is console output of candump without times; {remedy}, or with -ta")
        if "-" in found[0] or float(found[0]) > DATED_S:
            return
        times = np.array([float(text) for text in found])
        # Differences rise and fall, or are all the same; times from the first frame rise, but for those of another bus.
        travel = float(np.abs(np.diff(times[1:])).sum())
        rise = float(times[-1] - times[1]) / travel if travel else 0.0
        self._sums = times.size >= MIN_DIFFERENCES and rise < MAX_RISE
        if not self._sums and (times.size < MIN_TIMES or rise < MIN_RISE):
            raise SourceError(f"{path}: its times may be those of candump -tz (from the first frame) or -td; {remedy}")

    def __call__(self, line: str) -> can.Message | None:
        """Return the frame of a line; None if it is blank."""
        line = _plain(line)
        if not line:
            return None
        match = CONSOLE.fullmatch(line)
        if match is None or match["time"] is None:
            raise ValueError(f"it is no line of candump: {line[:40]}")
        date = ns_of_iso(match["time"].strip())
        time = _stamp(self._zone, date[0]) if date else float(match["time"]) + self._t * self._sums
        self._t = time
        size, rest, key = int(match["size"]), match["data"], match["id"]
        remote, error = "remote request" in rest, rest.endswith("ERRORFRAME")
        data = b"" if remote else bytes.fromhex(rest.strip()[: max(0, 3 * size - 1)])
        return _frame(round(time, 6), key, len(key) > 3, match["bus"], size, data, remote, error)


class AscLog(can.ASCReader):
    """python-can's reader of ASC, with the date as start of the times, any header, and symbolic names."""

    file: Any

    def __init__(self, file: TextIO, zone: str | None) -> None:
        super().__init__(file, relative_timestamp=False)
        self._zone, self._dated = zone, False

    def __iter__(self) -> Generator[can.Message, None, None]:
        for message in super().__iter__():
            if self._dated:  # A float of today's seconds holds no more.
                message.timestamp = round(message.timestamp, 6)
            yield message

    def _extract_header(self) -> None:
        for line in self.file:
            if re.match(r"\s*(-?\d+\.\d+\s|begin\s+triggerblock)", line, re.IGNORECASE):
                self.file.repeat()  # python-can would skip it.
                return
            if match := re.match(r"\s*date\s+(.*)", line, re.IGNORECASE):
                self.start_time = self._seconds(match[1])
            elif match := re.match(r"\s*base\s+(hex|dec)(?:\s+timestamps\s+(\w+))?", line, re.IGNORECASE):
                self._converted_base = self._check_base(match[1].lower())
                self.timestamps_format = (match[2] or "absolute").lower()

    def _datetime_to_timestamp(self, text: str) -> float:  # type: ignore[override]
        """Return the start of the times of a trigger block: its date if a measurement starts there, else the log's."""
        if following := next(self.file, ""):
            self.file.repeat()
        return (
            self._seconds(text) if "start of measurement" in following.lower() or not self._dated else self.start_time
        )

    def _seconds(self, text: str) -> float:
        # In German a month may be Mär, whose umlaut may be unreadable.
        texts = text.strip(), re.sub(r"\bm.r", "mar", text.strip().partition(" ")[2], flags=re.IGNORECASE)
        date = next(filter(None, (ns_of_date(one, False) for one in texts)), None)
        if date is None:
            log.warning("its date %r cannot be read; times do not count from 1970", text.strip())
            return self.start_time
        self._dated = True
        return _stamp(self._zone, date[0])

    def _process_classic_can_frame(self, line: str, msg_kwargs: dict[str, Any]) -> can.Message:
        # The first word may be a symbolic name.
        if "ID = " in line and (match := re.search(r"^(?!\s*errorframe).*\bID = (\d+)(x?)", line, re.IGNORECASE)):
            number = f"{int(match[1]):x}" if self._converted_base == 16 else match[1]
            line = re.sub(r"^\s*\S+", number + match[2], line)
        return super()._process_classic_can_frame(line, msg_kwargs)

    def _process_fd_can_frame(self, line: str, msg_kwargs: dict[str, Any]) -> can.Message:
        if line.lower().startswith("start of measurement"):
            return None  # type: ignore[return-value]  # python-can leaves it out
        if match := FD_LINE.match(line):
            head, flags, code, size, data = match.groups()
            dlc = code if self._converted_base == 16 else int(code, 16)  # hexadecimal in any log
            line = f"{head} {flags} {dlc} {size} {data} -"
        return super()._process_fd_can_frame(line, msg_kwargs)
