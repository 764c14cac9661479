"""Summarise recordings: messages and signals of CAN logs, columns of tables."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np

from estimators.errors import SourceError, nearest, quoted
from estimators.log import READING

from .can.database import load_database
from .can.decoder import Decoder, same_bus
from .can.ids import KnownIds
from .can.log import CanLog, check_log, frames_reader
from .can.readers import BusName, LogSummary, Raw
from .can.text_logs import DATED_S, is_frames
from .can.transport import Transport
from .dates import CLOCK, is_day
from .formats import CAN_LOGS, EITHER, check_once, check_present, holds_signals, suffix_of
from .source import UNDATED, Channel, ignore
from .tables.dialect import DETECTED, QUALITY_WORD, TIME_NAME, TIME_NAMES, Dialect
from .tables.order import Order, time_order
from .tables.rows import TableRows, cells_of, format_of, is_text, names_of, remarks_of, rows_of
from .tables.text import NO_VALUE, UNREADABLE, TextMatch
from .tables.times import EPOCH_S, SERIAL_DAYS, SKIPPED, TWICE, WHOLE_CLOCK, TimeColumn, TimeReader
from .units import heading_unit, suffix_unit, unknown_unit

MAX_FRAME_BYTES = 64  # Bytes of the longest frame, of CAN FD

MIN_GAP_S = 1.0
MIN_GAP_INTERVALS = 20.0
"""Seconds, or median intervals if they are longer, from which on a pause is a gap."""

TIME_UNITS = {
    spelling: unit
    for unit, spellings in {
        "s": "s sec secs second seconds sekunden",
        "ms": "ms msec millis milliseconds",
        "us": "us µs μs usec micros microseconds",
        "ns": "ns nsec nanos nanoseconds",
        "min": "min mins minute minutes minuten",
        "h": "h hr hrs hour hours std stunden",
        "d": "d day days tage",
    }.items()
    for spelling in spellings.split()
}
"""Units of time by their spellings in a heading."""

QUALITY = re.compile(r"qual|valid|güte", re.IGNORECASE)
GOOD_WORD = re.compile(r"good\b.*|ok|valid|normal|gut", re.IGNORECASE)
OPC_GOOD = 192
"""Names of columns of quality, its good words, and the least good number of OPC."""

MAX_TEXTS = 50  # Different texts of a column that are counted

TAG = re.compile(
    r"(^|[\W_])(id|ids|tag|tags|node|anchor|beacon|channel|sensor|point|signal|variable|item|metric|name|field|series|"
    r"messstelle|kanal)$|[a-z](Id|ID|Tag|Name)$|(tag|sensor|point)_?name$",
    re.IGNORECASE,
)
"""Names of columns that name the source of a row."""

MIN_ALTERNATION = 0.2  # Share of the rows at which such a column changes, from which on the rows are of several sources

MIN_SOURCE_VALUES = 20  # Rows of a source that is listed by itself

MAX_LEVELS = 8  # Different values up to which a column describes the source, and is no signal of it

HORIZON_NS = 2_000_000_000  # By which a row may be late in a twin, unless its YAML gives another time.max_delay

CODE_DISTANCE = 3.0  # Of a code from all values, in ranges of these
MIN_ODD_STEP_S = 1000.0  # From one row to the next, of times that do not count from 1970: their unit may be another
SERIAL_DAYS_SINCE_1970 = (10_957, 47_482)  # Of the years 2000 to 2100


@dataclass(frozen=True)
class SignalSeries:
    """Values of one signal or column: times (ns) and finite values, (n,); `missing` counts the others.

    `column` is the column of a table whose rows are of several sources, and `only` the column that names the source of
    a row, with its name there; or the signal of a J1939 message that several send, and `source` the sender's address.
    """

    name: str
    unit: str
    t: np.ndarray
    values: np.ndarray
    missing: int = 0
    column: str = ""
    only: tuple[str, str] | None = None
    source: int | None = None


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
    """Contents of recordings; `t` (ns) are the times of all records, in order.

    `kind` is "can_log", "table", or "merged" of several of these, its `parts`. `texts` counts the texts of the columns
    of a CSV that hold no number. `by` is the column that names the source of each row.
    """

    files: list[Path]
    kind: str
    t: np.ndarray
    messages: list[Message] = field(default_factory=list)
    columns: list[SignalSeries] = field(default_factory=list)
    time: TimeColumn = TimeColumn("")
    texts: dict[str, Counter[str]] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    by: str = ""
    dialect: Dialect = DETECTED
    parts: tuple[RecordingContents, ...] = ()

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
    """Return whether a file is read as a table; a CSV, a text or an MF4 may be either, by what it holds."""
    kind = suffix_of(path)
    if kind == ".mf4":
        return holds_signals(path)
    return not is_frames(path) if kind in EITHER else kind not in CAN_LOGS


def inspect_recordings(
    files: Sequence[Path],
    databases: Sequence[tuple[Path, BusName]] = (),
    time: TimeColumn | None = None,
    dialect: Dialect = DETECTED,
) -> RecordingContents:
    """Return the contents of recordings, CAN logs or tables.

    Args:
        files: In their order.
        databases: DBC files with the bus that each describes, None for every one.
        time: Time column of a table; None, or an empty name, searches for one.
        dialect: How a table is written, as far as it is not detected.

    Raises:
        SourceError: If a file cannot be read.
    """
    for path in files:
        if path.is_dir():
            raise SourceError(f"{path}: it is a folder; name the recordings in it")
        check_present(path)
    check_once(files)
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path in files:
        kind = ("table", *sorted(set(names_of(path, "", dialect)))) if is_table(path) else ("log",)
        groups.setdefault(kind, []).append(path)
    found = [
        _logs(group, list(databases), time.zone if time else None)
        if kind == "log"
        else _tables(group, time or TimeColumn(""), dialect)
        for (kind, *_), group in groups.items()
    ]
    return found[0] if len(found) == 1 else _merged(found)


def _merged(parts: list[RecordingContents]) -> RecordingContents:
    """Return the contents of recordings of several kinds, or of tables with different columns."""
    faults = [text for part in parts for text in part.faults]
    first, last = max(parts, key=lambda part: part.t[0]), min(parts, key=lambda part: part.t[-1])
    if first.t[0] > last.t[-1]:
        apart = (first.t[0] - last.t[-1]) * 1e-9
        faults.append(
            f"{first.files[0].name} begins {apart:.4g} s after the end of {last.files[0].name}; if they were recorded "
            "together, their clocks differ: give their times the same unit and zone, or shift one (time.shift)"
        )
    return RecordingContents(
        [path for part in parts for path in part.files],
        "merged",
        np.sort(np.concatenate([part.t for part in parts])),
        [message for part in parts for message in part.messages],
        [one for part in parts for one in part.columns],
        faults=faults,
        texts={name: counts for part in parts for name, counts in part.texts.items()},
        parts=tuple(parts),
    )


def _logs(files: list[Path], databases: list[tuple[Path, BusName]], zone: str | None) -> RecordingContents:
    found: dict[tuple[BusName, int], list[np.ndarray]] = defaultdict(list)
    whole: dict[tuple[BusName, int], list[int]] = defaultdict(list)
    faults = []
    errors = 0
    transport = Transport(None, ignore)
    for path in files:
        check_log(path)
        reader = frames_reader(path, None, MAX_FRAME_BYTES, zone)
        try:
            while not reader.ended:
                item = reader.get(1.0)
                if isinstance(item, Raw):
                    for place, bus in enumerate(item.buses):
                        rows = np.flatnonzero(item.bus == place)
                        for key in np.unique(item.key[rows]).tolist():
                            found[bus, key].append(item.t[rows[item.key[rows] == key]])
                    for row, bus, key, _ in transport.take_all(item) if databases else ():
                        whole[bus, key].append(int(item.t[row]))
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
    t = np.sort(np.concatenate([part for parts in found.values() for part in parts]))
    if zone is None and any(suffix_of(path) == ".asc" for path in files) and t[-1] * 1e-9 > DATED_S:
        faults.append(f"{files[0].name}: its date has no time zone and is taken to be UTC; give one with --time-zone")
    messages = _named(files, databases, found, whole, zone, faults)
    return RecordingContents(files, "can_log", t, messages, time=TimeColumn("", zone=zone), faults=faults)


def _named(
    files: list[Path],
    databases: list[tuple[Path, BusName]],
    frames: Mapping[tuple[BusName, int], list[np.ndarray]],
    whole: Mapping[tuple[BusName, int], Sequence[int]],
    zone: str | None,
    faults: list[str],
) -> list[Message]:
    """Return the messages with their names and signals by the databases.

    Args:
        files: The logs.
        databases: DBC files with their buses.
        frames: Times of the frames, by bus and id.
        whole: Times of messages of several packets, by bus and id.
        zone: Time zone of the dates of text logs.
        faults: Receives the problems.
    """
    reported: set[str] = set()

    def report(key: str, text: str) -> None:
        if key not in reported:
            reported.add(key)
            faults.append(text)

    named: dict[tuple[BusName, int], tuple[str, int | None]] = {}
    series: dict[tuple[str, int | None], list[SignalSeries]] = defaultdict(list)
    for path, bus in databases:
        known = KnownIds(load_database(path).messages)
        mine = {}
        for where, key in (*frames, *whole):
            found = known.find(key) if (where, key) not in named and same_bus(bus, where) else None
            if found is not None:
                source = key & 0xFF if known.ids(found).j1939 else None
                named[where, key] = found.name, source
                mine[found.name, source] = found
        senders = Counter(name for name, _ in mine)
        every = [(one, source, signal) for (_, source), one in mine.items() for signal in one.signals]
        channels = [
            Channel(
                READING, k, f"{one.name}.{signal.name}", (signal.name,), one.name,
                source=source if senders[one.name] > 1 else None,
            )
            for k, (one, source, signal) in enumerate(every)
        ]  # fmt: skip
        if not channels:
            continue
        log = CanLog(files, Decoder([(path, bus)], channels, width=1, report=report), refuse=False, zone=zone)
        parts = [(np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0))]
        try:
            while (batch := log.read(1.0)) is not None:
                parts.append((batch.t, batch.channel, batch.value[:, 0]))
        finally:
            log.close()
        t, index, values = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(index, kind="stable")
        edges = np.searchsorted(index[order], np.arange(len(channels) + 1))
        for k, ((one, source, signal), channel) in enumerate(zip(every, channels, strict=True)):
            rows = order[edges[k] : edges[k + 1]]
            rows = rows[np.argsort(t[rows], kind="stable")]
            read = _series(signal.name, signal.unit or "", t[rows], values[rows])
            if channel.source is not None:
                name = f"{signal.name}_{channel.source:#04x}"
                read = replace(read, name=name, column=signal.name, source=channel.source)
            series[one.name, source].append(read)
    # Frames of one sender with several priorities are one message.
    times: dict[tuple[object, ...], list[np.ndarray]] = defaultdict(list)
    first: dict[tuple[object, ...], tuple[BusName, int]] = {}
    for item in sorted({*frames, *(item for item in whole if item in named)}, key=lambda one: (str(one[0]), one[1])):
        same = (item[0], *named[item]) if item in named and named[item][1] is not None else item
        times[same] += [*frames.get(item, ()), np.array(whole.get(item, ()) if item in named else (), np.int64)]
        first.setdefault(same, item)
    return [
        Message(*item, np.sort(np.concatenate(times[same])), named[item][0], tuple(series[named[item]]))
        if item in named
        else Message(*item, np.sort(np.concatenate(times[same])))
        for same, item in first.items()
    ]


def _series(name: str, unit: str, t: np.ndarray, values: np.ndarray) -> SignalSeries:
    known = np.isfinite(values)
    return SignalSeries(name, unit, t[known], values[known], int(np.sum(~known)))


def _tables(files: list[Path], time: TimeColumn, dialect: Dialect) -> RecordingContents:
    names = names_of(files[0], "", dialect)
    chosen = time.name or _time_of(files[0], names, time, dialect)
    if time.name and time.name not in names:
        raise SourceError(f"--time {quoted(time.name)}: is no column of {files[0]}; {nearest(time.name, names)}")
    if len(names) < 2:
        raise SourceError(
            f"{files[0]}: has one column, {quoted(names[0] if names else '')}; a table has a header, a column of times "
            "and one of values" + ": if it has, give --delimiter, or --skip for lines before it" * is_text(files[0])
        )
    if chosen is None:
        raise SourceError(
            f"{files[0]}: which column holds the time is not known; name it with --time, one of {', '.join(names[:12])}"
        )
    time = _with_clock(files[0], names, time._replace(name=chosen), dialect)
    chosen = time.name
    named = TIME_UNITS.get(re.split(r"[\[(/_]", chosen.lower().rstrip(" )]"))[-1].strip())
    if time.unit == "s" and named is not None and not chosen.lower().endswith("of_day"):
        time = time._replace(unit=named)
    faults = remarks_of(files, dialect)
    copies = [name for name, count in Counter(names).items() if count > 1]
    if chosen in copies:
        raise SourceError(f"{files[0]}: there are {names.count(chosen)} columns {chosen!r}; give each its own name")
    if copies:
        faults.append(f"several columns are named {', '.join(copies)} and are left out; give each its own name")
    columns = [
        name for name in dict.fromkeys(names_of(files[0], chosen, dialect)) if name not in (*time.names, *copies)
    ]
    if other := [name for name in dict.fromkeys(names) if name not in (*time.names, *copies, *columns)]:
        shown = ", ".join(other[:3]) + (", ..." if len(other) > 3 else "")
        faults.append(
            f"{len(other)} columns have another number of rows than {chosen} and are left out: {shown}; name their "
            "own time column to read them"
        )
    form = format_of(files[0])
    written = form is None or form.cells is not None  # not x[1], a part of an array
    if strange := [name for name in columns if written and unknown_unit(name)]:
        more = f" and of {len(strange) - 1} more" if len(strange) > 1 else ""
        faults.append(f"the unit of {strange[0]}{more} is not known; give it under `units`")
    times, values, zoneless = [], [], False
    counted: dict[str, list[str]] = {UNDATED: [], TWICE: [], SKIPPED: []}
    order = Order(time.label, time.unit, HORIZON_NS, lambda key, text: None if text in faults else faults.append(text))
    if form is not None and form.sparse:
        return _sparse(files, time, columns, order, faults)
    for path in files:
        for rows in _rows(path, time, columns, faults, counted, dialect):
            time, zoneless = time._replace(unit=rows.unit), zoneless or rows.zoneless
            times.append(rows.t[rows.known])
            values.append(rows.values[rows.known])
            order.check(path.name, rows.line[rows.known], times[-1])
    undated = counted.pop(UNDATED)
    if not any(part.size for part in times):
        if undated:
            raise SourceError("; ".join([*faults, f"no row has a time; {undated[0]}"]))
        raise SourceError("; ".join(faults) or f"{files[0]}: it has a header and no rows; record it again")
    if undated:
        more = f"; so are {len(undated) - 1} more rows" if len(undated) > 1 else ""
        faults.append(undated[0] + more)
    t, v = np.concatenate(times), np.concatenate(values)
    if zoneless and t[-1] > DATED_S * 1e9:
        rule = "its dates have no time zone and are taken to be UTC; give one with --time-zone"
        faults.append(f"{files[0].name}: {rule}")
    step = float(np.median(np.abs(np.diff(t)))) * 1e-9 if t.size > 1 else 0.0
    if time.unit == "s" and step >= MIN_ODD_STEP_S and t[0] < EPOCH_S[0] * 1e9 and not zoneless:
        faults.append(f"{chosen} grows by {step:g} a row, taken as s; if that is ms, us or ns, give --time-unit")
    wordy = [name for name, column in zip(columns, v.T, strict=True) if not np.isfinite(column).any()]
    texts = _texts(files, wordy, dialect)
    for name, counts in texts.items():
        units = {text.lstrip("+-.,0123456789 ") for text in counts}
        if len(units) == 1 and not units & set(counts) and heading_unit(f"x [{(unit := units.pop())}]"):
            remedy = f"write the numbers alone, and {name} [{unit}] in the heading"
            faults.append(f"{name} has a unit in each cell, such as {quoted(next(iter(counts)))}: {remedy}")
    words = {key: key.removeprefix(NO_VALUE).partition(": ")[0] for key, rows in counted.items() if rows}
    faults += [
        f"{key} (rows: {len(counted[key])}, the first {counted[key][0]})"
        for key, name in words.items()
        if name not in texts
    ]
    by, labels, source = _source_of(files, time, dict(zip(columns, v.T, strict=True)), texts, t, dialect)
    order.report_late(time_order(t, source, HORIZON_NS) is not None)
    rank = np.argsort(t, kind="stable")
    t, v, source = t[rank], v[rank], source[rank]
    found = []
    for name, column in zip(columns, v.T, strict=True):
        one = _series(name, heading_unit(name) or suffix_unit(name), t, column)
        levels, count = np.unique(one.values, return_counts=True)
        faults += _codes(name, levels, count)
        split = name != by and labels and levels.size > MAX_LEVELS
        found += _split(one, by, labels, t, column, source) if split else [one]
    for unit, origin in SERIAL_DAYS.items() if time.unit == "s" and t[-1] - t[0] < 0.5e9 * t.size else ():
        low, high = ((origin + days) * 10**9 for days in SERIAL_DAYS_SINCE_1970)
        if low <= t[0] and t[-1] <= high:
            faults.append(f"column {chosen} looks like serial dates of {unit}: add --time-unit {unit}")
    return RecordingContents(
        files, "table", t, columns=found, time=time, faults=faults, texts=texts, by=by, dialect=dialect
    )


def _codes(name: str, levels: np.ndarray, count: np.ndarray) -> Iterator[str]:
    """Yield that the lowest or the highest value of a column may stand for a missing one, as -999 does."""
    for k, others in ((0, levels[1:]), (-1, levels[:-1])) if levels.size > MAX_LEVELS else ():
        if count[k] > 2 and np.abs(others - levels[k]).min() > CODE_DISTANCE * np.ptp(others):
            low, high = others[0] - np.ptp(others), others[-1] + np.ptp(others)
            rule = f"if that is a missing value, set {name}: [{low:.4g}, {high:.4g}] in valid_if of its sensor"
            yield f"{name} is {levels[k]:g} in {count[k]:,} rows, far from all other values; {rule}"


def _sparse(
    files: list[Path], time: TimeColumn, columns: list[str], order: Order, faults: list[str]
) -> RecordingContents:
    """Return the contents of tables whose rows each have only some of the columns."""
    times = []
    cells: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in columns}
    for path in files:
        for rows in _rows(path, time, columns, faults, {UNDATED: []}):
            times.append(rows.t)
            order.check(path.name, rows.line, rows.t)
            for k in np.flatnonzero(~rows.blank.all(axis=0)):
                there = ~rows.blank[:, k]
                cells[columns[k]].append((rows.t[there], rows.values[there, k]))
    if not any(part.size for part in times):
        raise SourceError("; ".join(faults) or f"{files[0]}: it has no messages; record it again")
    order.report_late(True)
    found = []
    for name, parts in cells.items():
        t, values = (np.concatenate(column) for column in zip(*parts, strict=True)) if parts else np.zeros((2, 0))
        rank = np.argsort(t, kind="stable")
        found.append(_series(name, heading_unit(name) or suffix_unit(name), t[rank].astype(np.int64), values[rank]))
    return RecordingContents(files, "table", np.sort(np.concatenate(times)), columns=found, time=time, faults=faults)


def _source_of(
    files: list[Path],
    time: TimeColumn,
    columns: dict[str, np.ndarray],
    texts: dict[str, Counter[str]],
    t: np.ndarray,
    dialect: Dialect,
) -> tuple[str, list[str], np.ndarray]:
    """Return the column that names the source of each row, the names, and the source of each row by its number.

    Without such a column all rows have the source 0.
    """
    rank = np.argsort(t, kind="stable")
    best: tuple[str, list[str], np.ndarray] = "", [], np.zeros(t.size, np.int64)

    def consider(name: str, labels: list[str], source: np.ndarray) -> None:
        nonlocal best
        if len(best[1]) < len(labels) <= MAX_TEXTS and np.mean(np.diff(source[rank]) != 0) > MIN_ALTERNATION:
            best = name, labels, source

    for name, column in columns.items():
        if TAG.search(name) and np.isfinite(column).all() and np.all(column == np.round(column)):
            ids, source = np.unique(column, return_inverse=True)
            if ids.size > 1:
                consider(name, [f"{value:.0f}" for value in ids], source)
    for name, counts in texts.items():
        if 1 < len(counts) < MAX_TEXTS and TAG.search(name):
            labels = sorted(counts)
            matches = [TextMatch(name, (label,)) for label in labels]
            parts = (part for path in files for part in rows_of(path, time, matches, lambda: 1.0, dialect))
            found = np.concatenate([part.values[part.known] for part in parts if part is not None])
            if found.shape[0] == t.size and np.all(np.nansum(found, axis=1) == 1.0):
                consider(name, labels, np.argmax(found, axis=1))
    return best


def _split(
    one: SignalSeries, by: str, labels: list[str], t: np.ndarray, values: np.ndarray, source: np.ndarray
) -> list[SignalSeries]:
    """Return the series of each source that has enough values."""
    parts = []
    for k, label in enumerate(labels):
        rows = source == k
        part = _series(f"{one.name}_{label}", one.unit, t[rows], values[rows])
        if part.values.size >= MIN_SOURCE_VALUES:
            parts.append(replace(part, column=one.name, only=(by, label)))
    return parts


def _rows(
    path: Path,
    time: TimeColumn,
    columns: list[str],
    faults: list[str],
    counted: dict[str, list[str]],
    dialect: Dialect = DETECTED,
) -> Iterator[TableRows]:
    """Yield the rows of one table as far as it can be read; problems of a key in `counted` are added there."""
    try:
        for rows in rows_of(path, time, columns, lambda: 1.0, dialect):
            if rows is not None:
                for key, line, text in rows.problems:
                    if key.startswith(NO_VALUE):
                        counted.setdefault(key, []).append(f"{path.name}:{line}")
                    elif key != UNREADABLE:
                        counted.get(key, faults).append(f"{path.name}:{line}: {text}")
                    elif (name := text.partition(" is ")[0]) in columns:
                        seen = counted.setdefault(f"{name}: no number", [])
                        seen.append("" if seen else f"{path.name}:{line}: {text}")
                yield rows
    except SourceError as error:
        faults.append(str(error))


def _time_of(path: Path, names: Sequence[str], time: TimeColumn, dialect: Dialect) -> str | None:
    """Return the time column, by its name, as the first one of dates, or as the first that counts from 1970.

    Dates that stay the same, such as the begin and end of a query, are taken only if there are no others.
    """
    # T is a temperature more often, as is T [°C].
    able = [name for name in names if name != "T" and (heading_unit(name) or "s").lower() in TIME_UNITS]
    last = {_bare(name): name for name in reversed(able)}
    named = next((last[name] for name in TIME_NAMES if name in last), None)
    like = next((name for name in able if TIME_NAME.search(name)), None)
    if named is not None or (cells := cells_of(path, dialect)) is None:
        return named or like
    rows = [[cell.strip() for cell in row] for row in islice(cells, MAX_TEXTS) if len(row) >= len(names)]
    columns = dict(zip(names, zip(*rows, strict=False), strict=False))
    texts = {
        name: column
        for name, column in columns.items()
        if not column[0].replace(",", "").replace(".", "").lstrip("+-").isdigit()
    }
    moving = {name: column for name, column in texts.items() if len({*column}) > 1 or len(rows) == 1}
    for among in (moving, texts):
        for pattern in (None, CLOCK):
            for name, column in among.items():
                if pattern.fullmatch(column[0]) if pattern else TimeReader(time._replace(name=name)).is_date(column[0]):
                    return name
        if like is not None:
            return like
    return next((name for name, column in columns.items() if _since_1970(column)), None)


def _bare(name: str) -> str:
    """Return the name of a column without its path and its unit of time."""
    text = re.split(r"[\[(/]", name.lower().rpartition(".")[2])[0].strip()
    base, _, unit = text.rpartition("_")
    return base if base and unit in TIME_UNITS else text


def _since_1970(cells: Sequence[str]) -> bool:
    """Return whether numbers rise and are times since 1970, in any unit."""
    try:
        numbers = np.array(cells, np.float64)
    except ValueError:
        return False
    low, high = (end * np.array([1.0, 1e3, 1e6, 1e9]) for end in EPOCH_S)
    rising = numbers.size > 1 and numbers[-1] > numbers[0] and bool(np.all(np.diff(numbers) >= 0.0))
    return rising and bool(np.any((low <= numbers[0]) & (numbers[-1] <= high)))


def _with_clock(path: Path, names: Sequence[str], time: TimeColumn, dialect: Dialect) -> TimeColumn:
    """Return the time column; both, if it is one of a CSV with dates in one column and clocks in another."""
    rows = [[cell.strip() for cell in row] for row in islice(cells_of(path, dialect) or (), MAX_TEXTS)]
    days, clocks, numbers = (
        [k for k in range(len(names)) if rows and all(is_one(row[k]) for row in rows)]
        for is_one in (is_day, CLOCK.fullmatch, WHOLE_CLOCK.fullmatch)
    )
    chosen = names.index(time.name)
    if time.clock is None and clocks and chosen in days:
        return time._replace(clock=names[min(clocks, key=lambda k: abs(k - chosen))])
    return time._replace(name=names[days[0]], clock=time.name) if days and chosen in clocks + numbers else time


def _texts(files: list[Path], names: list[str], dialect: Dialect) -> dict[str, Counter[str]]:
    found: dict[str, Counter[str]] = {name: Counter() for name in names}
    for path in files if names else ():
        if (cells := cells_of(path, dialect)) is not None:
            places = [(counts, names_of(path, "", dialect).index(name)) for name, counts in found.items()]
            for row in cells:
                for counts, place in places:
                    text = row[place].strip()
                    if text and (text in counts or len(counts) < MAX_TEXTS):
                        counts[text] += 1
    return {name: counts for name, counts in found.items() if counts}


def quality_conditions(found: RecordingContents) -> list[str]:
    """Return the columns by which rows of bad quality can be left out, with the condition."""
    lines: list[tuple[str, str, int, object]] = []
    for name, words in found.texts.items():
        good = [word for word in words if GOOD_WORD.fullmatch(word)]
        bad = [word for word in words if QUALITY_WORD.fullmatch(word) or (QUALITY.search(name) and word not in good)]
        if good and bad:
            lines.append((name, ", ".join(map(quoted, bad[:3])), sum(words[word] for word in bad), good))
    for one in found.columns:
        if QUALITY.search(one.name) and one.values.size and 0 <= one.values.min() < OPC_GOOD <= one.values.max() < 256:
            below = int(np.sum(one.values < OPC_GOOD))
            lines.append((one.name, f"below {OPC_GOOD}", below, [OPC_GOOD, None]))
    return [
        f"{name} is {what} (rows: {count}); to leave these rows out give valid_if: "
        + json.dumps({name: good}, ensure_ascii=False)
        for name, what, count, good in lines
    ]
