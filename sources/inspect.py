"""Summarise recordings: messages and signals of CAN logs, columns of tables."""

from __future__ import annotations

import csv
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from estimators.errors import SourceError, shown_name
from estimators.log import READING

from .can.decoder import Decoder, load_database, same_bus
from .can.log import CanLog, check_log, frames_reader
from .can.readers import EXTENDED, BusName, LogSummary, Raw
from .formats import CAN_LOGS, suffix_of
from .source import Channel
from .tables.rows import TableRows, is_text, names_of, rows_of
from .tables.text import UNREADABLE, csv_format, open_text
from .tables.times import TimeColumn, TimeReader
from .units import heading_unit

MAX_FRAME_BYTES = 64  # Bytes of the longest frame, of CAN FD

MIN_GAP_S = 1.0
MIN_GAP_INTERVALS = 20.0
"""Seconds, or median intervals if they are longer, from which on a pause is a gap."""

TIME_NAMES = (
    "t", "time", "timestamp", "seconds", "time_s", "t_s", "date", "datetime", "unix_time", "elapsed", "zeit",
    "zeitstempel", "datum", "horodatage", "fecha",
)  # fmt: skip
"""Usual names of a time column; otherwise the first column of dates is taken."""

MAX_TEXTS = 50  # Different texts of a column that are counted

SERIAL_DATES = (36_526, 73_051)  # Days of the years 2000 to 2100 in Excel's count


@dataclass(frozen=True)
class SignalSeries:
    """Values of one signal or column: times (ns) and finite values, (n,); `missing` counts the others."""

    name: str
    unit: str
    t: np.ndarray
    values: np.ndarray
    missing: int = 0


@dataclass(frozen=True)
class Message:
    """Frames of one id on one bus: times (ns), and name and signals by a DBC, if one is given."""

    bus: BusName
    key: int
    t: np.ndarray
    name: str | None = None
    signals: tuple[SignalSeries, ...] = ()


@dataclass
class RecordingContents:
    """Contents of recordings of one kind; `t` (ns) are the times of all records, in order.

    `texts` counts the texts of the columns of a CSV that hold no number.
    """

    files: list[Path]
    kind: str
    t: np.ndarray
    messages: list[Message] = field(default_factory=list)
    columns: list[SignalSeries] = field(default_factory=list)
    time: TimeColumn = TimeColumn("")
    texts: dict[str, Counter[str]] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)

    @property
    def holes(self) -> list[tuple[int, int]]:
        """Gaps in the recording: start and end, ns."""
        return holes(self.t)


def holes(t: np.ndarray) -> list[tuple[int, int]]:
    """Return gaps between ordered times that are far longer than the median interval."""
    gaps = np.diff(t)
    if not gaps.any():
        return []
    long = np.flatnonzero(gaps > max(MIN_GAP_S * 1e9, MIN_GAP_INTERVALS * float(np.median(gaps[gaps > 0]))))
    return [(int(t[k]), int(t[k + 1])) for k in long]


def is_table(path: Path) -> bool:
    """Return whether a file is read as a table; a CSV with the header of python-can is a CAN log."""
    if suffix_of(path) not in CAN_LOGS:
        return True
    if suffix_of(path) != ".csv":
        return False
    return csv_format(path).names[:2] != ["timestamp", "arbitration_id"]


def inspect_recordings(
    files: Sequence[Path], databases: Sequence[tuple[Path, BusName]] = (), time: TimeColumn | None = None
) -> RecordingContents:
    """Return the contents of recordings of one kind, CAN logs or tables.

    Args:
        files: In their order.
        databases: DBC files with the bus that each describes, None for every one.
        time: Time column of a table; None, or an empty name, searches for one.

    Raises:
        SourceError: If a file cannot be read, or the kinds are mixed.
    """
    for path in files:
        if path.is_dir():
            raise SourceError(f"{path}: it is a folder; name the recordings in it")
        if not path.is_file():
            raise SourceError(f"{path}: there is no such file; check the path")
        if not path.stat().st_size:
            raise SourceError(f"{path}: the file is empty; record it again")
    kinds = [is_table(path) for path in files]
    if any(kinds) != all(kinds):
        raise SourceError(f"{files[kinds.index(True)]} is a table and {files[kinds.index(False)]} a log; give one kind")
    if all(kinds):
        return _tables(list(files), time or TimeColumn(""))
    return _logs(list(files), list(databases))


def _logs(files: list[Path], databases: list[tuple[Path, BusName]]) -> RecordingContents:
    found: dict[tuple[BusName, int], list[np.ndarray]] = defaultdict(list)
    faults = []
    errors = 0
    for path in files:
        check_log(path)
        reader = frames_reader(path, None, MAX_FRAME_BYTES)
        try:
            while not reader.ended:
                item = reader.take(1.0)
                if isinstance(item, Raw):
                    for place, bus in enumerate(item.buses):
                        rows = np.flatnonzero(item.bus == place)
                        for key in np.unique(item.key[rows]).tolist():
                            found[bus, key].append(item.t[rows[item.key[rows] == key]])
                elif isinstance(item, LogSummary):
                    errors += item.errors
                    if item.fault:
                        faults.append(f"{path.name}: damaged: {item.fault}")
        except SourceError as error:
            text = str(error).removeprefix(f"{path}: ")
            faults.append(f"{path.name}: {text}")
        finally:
            reader.close()
    if not found:
        raise SourceError("; ".join(faults) or f"{files[0]}: it holds no frames")
    if errors:
        faults.append(f"{errors} error frames")
    messages = [
        Message(bus, key, np.sort(np.concatenate(parts)))
        for (bus, key), parts in sorted(found.items(), key=lambda entry: (str(entry[0][0]), entry[0][1]))
    ]
    if databases:
        messages = _named(files, databases, messages, faults)
    t = np.sort(np.concatenate([message.t for message in messages]))
    return RecordingContents(files, "can_log", t, messages, faults=faults)


def _named(
    files: list[Path], databases: list[tuple[Path, BusName]], messages: list[Message], faults: list[str]
) -> list[Message]:
    """Return the messages with their names and signals by the databases."""
    reported: set[str] = set()

    def report(key: str, text: str) -> None:
        if key not in reported:
            reported.add(key)
            faults.append(text)

    named: dict[int, tuple[str, Path]] = {}
    series: dict[tuple[str, str], SignalSeries] = {}
    for path, bus in databases:
        by_key = {m.frame_id | (EXTENDED if m.is_extended_frame else 0): m for m in load_database(path).messages}
        mine = {}
        for k, message in enumerate(messages):
            if k not in named and message.key in by_key and same_bus(bus, message.bus):
                named[k] = (by_key[message.key].name, path)
                mine[message.key] = by_key[message.key]
        channels = [
            Channel(READING, k, f"{message.name}.{signal.name}", (signal.name,), message.name)
            for k, (message, signal) in enumerate((m, s) for m in mine.values() for s in m.signals)
        ]
        if not channels:
            continue
        units = {(m.name, s.name): s.unit or "" for m in mine.values() for s in m.signals}
        log = CanLog(files, Decoder([(path, bus)], channels, width=1, report=report))
        parts = [(np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0))]
        try:
            while (batch := log.read(1.0)) is not None:
                parts.append((batch.t, batch.channel, batch.value[:, 0]))
        finally:
            log.close()
        t, index, values = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(index, kind="stable")
        edges = np.searchsorted(index[order], np.arange(len(channels) + 1))
        for k, channel in enumerate(channels):
            assert channel.message is not None
            rows = order[edges[k] : edges[k + 1]]
            rows = rows[np.argsort(t[rows], kind="stable")]
            name = (channel.message, channel.signals[0])
            series[name] = _series(channel.signals[0], units[name], t[rows], values[rows])
    return [
        Message(
            message.bus, message.key, message.t, named[k][0], tuple(v for n, v in series.items() if n[0] == named[k][0])
        )
        if k in named
        else message
        for k, message in enumerate(messages)
    ]


def _series(name: str, unit: str, t: np.ndarray, values: np.ndarray) -> SignalSeries:
    known = np.isfinite(values)
    return SignalSeries(name, unit, t[known], values[known], int(np.sum(~known)))


def _tables(files: list[Path], time: TimeColumn) -> RecordingContents:
    names = names_of(files[0])
    chosen = time.name or _time_of(files[0], names, time)
    if chosen is None or chosen not in names:
        raise SourceError(
            f"{files[0]}: which column holds the time is not known; name it with --time, one of {', '.join(names[:12])}"
        )
    time = time._replace(name=chosen)
    faults: list[str] = []
    columns = [name for name in dict.fromkeys(names_of(files[0], chosen)) if name != chosen]
    if other := [name for name in dict.fromkeys(names) if name != chosen and name not in columns]:
        shown = ", ".join(other[:3]) + (", ..." if len(other) > 3 else "")
        faults.append(
            f"{len(other)} columns have another number of rows than {chosen} and are left out: {shown}; name their "
            "own time column to read them"
        )
    for path in files[1:]:
        missing = [name for name in (chosen, *columns) if name not in names_of(path)]
        if missing:
            raise SourceError(
                f"{path}: it has no column {shown_name(missing[0])}, which {files[0]} has; "
                "give tables with the same columns"
            )
    times, values = [], []
    for path in files:
        for rows in _rows(path, time, columns, faults):
            times.append(rows.t[rows.known])
            values.append(rows.values[rows.known])
    if not any(part.size for part in times):
        raise SourceError(
            "; ".join(faults)
            or f"{files[0]}: no row has a time in column {chosen}; give its unit (--time-unit) or format "
            "(--time-format), or another column"
        )
    t, v = np.concatenate(times), np.concatenate(values)
    order = np.argsort(t, kind="stable")
    t, v = t[order], v[order]
    found = [_series(name, heading_unit(name) or "", t, v[:, k]) for k, name in enumerate(columns)]
    low, high = (end * 10**9 for end in SERIAL_DATES)
    if time.unit == "s" and low <= t[0] and t[-1] <= high and t[-1] - t[0] < 0.5e9 * t.size:
        faults.append(f"column {chosen} looks like Excel's serial dates: add --time-unit excel")
    texts = _texts(files, [one.name for one in found if not one.t.size])
    return RecordingContents(files, "table", t, columns=found, time=time, faults=faults, texts=texts)


def _rows(path: Path, time: TimeColumn, columns: list[str], faults: list[str]) -> Iterator[TableRows]:
    """Yield the rows of one table as far as it can be read."""
    try:
        for rows in rows_of(path, time, columns, lambda: 1.0):
            if rows is not None:
                faults += [f"{path.name}:{line}: {text}" for key, line, text in rows.problems if key != UNREADABLE]
                yield rows
    except SourceError as error:
        faults.append(str(error))


def _cells(path: Path) -> Iterator[list[str]]:
    """Yield the cells of the rows of a CSV."""
    form = csv_format(path)
    with open_text(path, form.encoding) as file:
        for row in islice(csv.reader(file, delimiter=form.delimiter), 1, None):
            if len(row) == len(form.names):
                yield row


def _time_of(path: Path, names: Sequence[str], time: TimeColumn) -> str | None:
    """Return the time column, by its name or as the first one of dates."""
    last = {name.lower().rpartition(".")[2].partition("[")[0].strip(): name for name in reversed(names)}
    named = next((last[name] for name in TIME_NAMES if name in last), None)
    if named is not None or not is_text(path):
        return named
    row = next(_cells(path), [])
    for name, cell in zip(names, row, strict=False):
        if not cell.strip().replace(",", "").replace(".", "").lstrip("+-").isdigit():
            reader = TimeReader(time._replace(name=name))
            if reader.is_date(cell.strip()):
                return name
    return None


def _texts(files: list[Path], names: list[str]) -> dict[str, Counter[str]]:
    found: dict[str, Counter[str]] = {name: Counter() for name in names}
    for path in files if names else ():
        if is_text(path):
            places = [(counts, names_of(path).index(name)) for name, counts in found.items()]
            for row in _cells(path):
                for counts, place in places:
                    text = row[place].strip()
                    if text and (text in counts or len(counts) < MAX_TEXTS):
                        counts[text] += 1
    return {name: counts for name, counts in found.items() if counts}
