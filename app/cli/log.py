"""`nisus log FILE...`: list the content of recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from estimators.diagnostics.repeats import find_repeats
from estimators.errors import ConfigError, quoted
from sources.can.ids import shown_id
from sources.can.readers import EXTENDED, BusName
from sources.formats import files_of
from sources.inspect import Message, RecordingContents, SignalSeries, inspect_recordings, is_table

from ..format_time import FIRST_DATED_NS, format_time
from ..render.text import to_text
from ..result import Cell, JsonObject, TableColumn, Topic, to_json
from ..study.advice.signals import rate_of
from ..study.log_overview import duration, facts_of, how_to_read, listed_faults
from ..terminal import complain
from .arguments import LogCommand as Arguments
from .arguments import TableOptions
from .prepare import attend

TIMES = (
    "number",
    TableColumn("rate [1/s]", absent=""),
    TableColumn("from [s]", 1, absent=""),
    TableColumn("to [s]", 1, absent=""),
    TableColumn("longest gap [s]", absent=""),
    TableColumn("lowest", absent=""),
    TableColumn("highest", absent=""),
)


def show_log(arguments: Arguments) -> int:
    """Print what a recording holds."""
    found = contents_of(arguments.files, arguments)
    if arguments.json:
        print(to_json(_as_dict(found)))
        return 0
    complain_of(found)
    print(to_text([_topic(part) for part in found.parts or (found,)]))
    return 0


def complain_of(found: RecordingContents) -> None:
    """Print what is wrong with a recording, and what was assumed to read it."""
    for text in listed_faults(found):
        complain(text)


def contents_of(files: tuple[Path, ...], options: TableOptions) -> RecordingContents:
    """Return the content of recordings, CAN logs or tables.

    Raises:
        ConfigError: If an argument is wrong.
        SourceError: If a file cannot be read.
    """
    if not files:
        raise ConfigError("no recording is named; give at least one")
    time, dialect = how_to_read(options, "time_", "--")
    files, databases = tuple(one for file in files for one in files_of(file.expanduser())), databases_of(options)
    for path, _ in databases:
        if not path.is_file():
            raise ConfigError(f"--dbc {path}: there is no such file; check the path")
    tables = [is_table(file) for file in files if file.is_file()]
    if databases and tables and all(tables):
        rule = f"describes CAN logs, and {files[0]} is a table"
        raise ConfigError(
            f"--dbc {databases[0][0]}: {rule}; leave it out, or export frames that it holds as ASC or BLF"
        )
    if options.time and tables and not any(tables):
        raise ConfigError(f"--time {quoted(options.time)}: is for tables, and {files[0]} is a CAN log; leave it out")
    more = f" and {len(files) - 1} more" if len(files) > 1 else ""
    return attend(None, lambda: inspect_recordings(files, databases, time, dialect), f"reading {files[0].name}{more}")


def databases_of(options: TableOptions) -> list[tuple[Path, BusName]]:
    """Return the files and buses of `--dbc`."""
    return [database_of(text) for text in options.dbc]


def database_of(text: str) -> tuple[Path, BusName]:
    """Return the file and the bus of FILE or FILE@BUS."""
    name, at, bus = text.rpartition("@")
    if not at or Path(text).expanduser().is_file():
        return Path(text).expanduser(), None
    return Path(name).expanduser(), int(bus) if bus.isdigit() else bus


def _topic(found: RecordingContents) -> Topic:
    start, end = int(found.t[0]), int(found.t[-1])
    name = found.files[0].name + (f" and {len(found.files) - 1} more" if len(found.files) > 1 else "")
    unit = "frames" if found.kind == "can_log" else "rows"
    when = f", from {format_time(start)}" if start >= FIRST_DATED_NS else ""
    title = f"{name}: {found.t.size} {unit} in {duration(end - start)}{when}"
    if found.kind == "table":
        rows = tuple((series.name, series.unit, *_series_cells(series, start)) for series in found.columns)
        return Topic(title, tuple(facts_of(found)), ("column", "unit", *TIMES), rows)
    lines: list[tuple[Cell, ...]] = []
    for message in found.messages:
        bus = "" if message.bus is None else str(message.bus)
        times = *_time_cells(message.t, start), None, None
        lines.append((bus, shown_id(message.key), message.name or "", "", *times))
        with_values = [series for series in message.signals if series.t.size]
        lines += [("", "", f"  {one.name}", one.unit, *_series_cells(one, start)) for one in with_values]
        if empty := len(message.signals) - len(with_values):
            lines.append(("", "", f"  {empty} signals without a value", "", *[None] * len(TIMES)))
    columns = ("bus", "id", "message, signals", "unit", TableColumn("number", absent=""), *TIMES[1:])
    return Topic(title, tuple(facts_of(found)), columns, tuple(lines))


def _time_cells(t: np.ndarray, start: int) -> tuple[Cell, ...]:
    if not t.size:
        return 0, None, None, None, None
    gap = float(np.diff(t).max()) * 1e-9 if t.size > 1 else None
    return int(t.size), rate_of(t), float(t[0] - start) * 1e-9, float(t[-1] - start) * 1e-9, gap


def _series_cells(series: SignalSeries, start: int) -> tuple[Cell, ...]:
    low, high = (float(series.values.min()), float(series.values.max())) if series.values.size else (None, None)
    return *_time_cells(series.t, start), low, high


def _as_dict(found: RecordingContents) -> JsonObject:
    if found.parts:
        return {"kind": found.kind, "parts": [_as_dict(part) for part in found.parts]}
    content: JsonObject = (
        {"messages": [_message(message) for message in found.messages]}
        if found.kind == "can_log"
        else {"time": found.time.name, "columns": [_series(series) for series in found.columns]}
    )
    return {
        "files": [str(path) for path in found.files],
        "kind": found.kind,
        "number": int(found.t.size),
        "start_ns": found.t[0],
        "end_ns": found.t[-1],
        "holes_ns": found.holes,
        "faults": found.faults,
        **content,
    }


def _message(message: Message) -> JsonObject:
    return {
        "bus": message.bus,
        "id": message.key & ~EXTENDED,
        "extended": bool(message.key & EXTENDED),
        "name": message.name,
        **_span(message.t),
        "signals": [_series(series) for series in message.signals],
    }


def _span(t: np.ndarray) -> JsonObject:
    return {
        "number": int(t.size),
        "rate": rate_of(t),
        "start_ns": t[0] if t.size else None,
        "end_ns": t[-1] if t.size else None,
        "longest_gap_ns": np.diff(t).max() if t.size > 1 else None,
    }


def _series(series: SignalSeries) -> JsonObject:
    known, repeats = series.values.size > 0, find_repeats(series.t, series.values)
    return {
        "name": series.name,
        "unit": series.unit,
        **_span(series.t),
        "missing": series.missing,
        "repeats": repeats._asdict() if repeats.found else None,
        "low": series.values.min() if known else None,
        "high": series.values.max() if known else None,
    }
