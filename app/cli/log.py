"""`nisus log FILE...`: what recordings hold, before any twin is there."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from estimators.errors import ConfigError
from sources.can.decoder import shown_id
from sources.can.frames import EXTENDED, BusName
from sources.inspect import Message, RecordingContents, Series, inspect_recordings
from sources.tables.rows import UNITS

from ..format_time import FIRST_DATED_NS, format_time
from ..terminal import complain

if TYPE_CHECKING:
    from .arguments import Log as Arguments

WIDTH = 160
"""Columns of the output where it is not a terminal."""

SHOWN = 5
"""Holes and faults that are listed; of the rest their number."""


def show_log(arguments: Arguments) -> int:
    """Carry the command out."""
    found = look(arguments.files, arguments.dbc, arguments.time, arguments.time_unit)
    if arguments.json:
        print(json.dumps(_as_dict(found)))
        return 0
    for text in found.faults[:SHOWN]:
        complain(text)
    if len(found.faults) > SHOWN:
        complain(f"and {len(found.faults) - SHOWN} more faults")
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    for line in _head(found):
        console.print(escape(line), highlight=False)
    console.print(_messages(found) if found.kind == "can_log" else _columns(found))
    return 0


def look(files: tuple[Path, ...], dbc: tuple[str, ...], time: str | None, unit: str) -> RecordingContents:
    """What the recordings hold.

    Args:
        files: CAN logs, or tables.
        dbc: DBC files, FILE or FILE@BUS.
        time: The column of tables that tells the time; None looks for one.
        unit: Its unit.

    Raises:
        ConfigError: If an argument cannot be.
        SourceError: If a file cannot be read.
    """
    if not files:
        raise ConfigError("no recording is named; give at least one")
    if unit not in UNITS:
        raise ConfigError(f"--time-unit {unit}: is no unit of time; choose from {', '.join(UNITS)}")
    return inspect_recordings([file.expanduser() for file in files], [database_of(text) for text in dbc], time, unit)


def database_of(text: str) -> tuple[Path, BusName]:
    """FILE or FILE@BUS: a DBC, and the bus on which it holds."""
    name, at, bus = text.rpartition("@")
    if not at or Path(text).expanduser().is_file():
        return Path(text).expanduser(), None
    return Path(name).expanduser(), int(bus) if bus.isdigit() else bus


def rate(t: np.ndarray) -> float:
    """Usual number a second: by the median of the intervals, which holes do not change."""
    gaps = np.diff(t)
    gaps = gaps[gaps > 0]
    return 1e9 / float(np.median(gaps)) if gaps.size else math.nan


def _seconds(t: int, start: int) -> float:
    return (t - start) * 1e-9


def _head(found: RecordingContents) -> list[str]:
    start, end = int(found.t[0]), int(found.t[-1])
    name = found.files[0].name + (f" and {len(found.files) - 1} more" if len(found.files) > 1 else "")
    what = "frames" if found.kind == "can_log" else "rows"
    span = (end - start) * 1e-9
    when = f", from {format_time(start)}" if start >= FIRST_DATED_NS else ""
    lines = [f"{name}: {found.t.size} {what} in {span:.1f} s{when}"]
    gaps = found.holes
    if gaps:
        shown = ", ".join(f"{(b - a) * 1e-9:.1f} s at {_seconds(a, start):.1f} s" for a, b in gaps[:SHOWN])
        more = f", and {len(gaps) - SHOWN} more" if len(gaps) > SHOWN else ""
        lines.append(f"{len(gaps)} holes: {shown}{more}")
    else:
        lines.append("no holes")
    if found.kind == "table":
        lines.append(f"time: column {found.time}")
    return lines


def _plain(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.5g}"


def _messages(found: RecordingContents) -> Table:
    table = Table()
    for title in ("bus", "id", "message, signals", "unit"):
        table.add_column(title, no_wrap=True)
    for title in ("number", "a second", "from s", "to s", "longest gap s", "lowest", "highest"):
        table.add_column(title, justify="right")
    start = int(found.t[0])
    for message in found.messages:
        bus = "" if message.bus is None else str(message.bus)
        table.add_row(bus, shown_id(message.key), escape(message.name or ""), "", *_times(message.t, start), "", "")
        silent = sum(not series.t.size for series in message.signals)
        for series in (series for series in message.signals if series.t.size):
            table.add_row("", "", f"  {escape(series.name)}", escape(series.unit), *_values(series, start))
        if silent:
            table.add_row("", "", f"  {silent} signals without a value", *[""] * 8)
    return table


def _columns(found: RecordingContents) -> Table:
    table = Table()
    table.add_column("column", no_wrap=True)
    for title in ("values", "a second", "from s", "to s", "longest gap s", "lowest", "highest"):
        table.add_column(title, justify="right")
    for series in found.columns:
        table.add_row(escape(series.name), *_values(series, int(found.t[0])))
    return table


def _times(t: np.ndarray, start: int) -> list[str]:
    if not t.size:
        return ["0", "", "", "", ""]
    gap = f"{np.diff(t).max() * 1e-9:.4g}" if t.size > 1 else ""
    return [str(t.size), _plain(rate(t)), f"{_seconds(t[0], start):.1f}", f"{_seconds(t[-1], start):.1f}", gap]


def _values(series: Series, start: int) -> list[str]:
    if not series.values.size:
        return [*_times(series.t, start), "", ""]
    return [*_times(series.t, start), _plain(float(series.values.min())), _plain(float(series.values.max()))]


def _as_dict(found: RecordingContents) -> dict[str, Any]:
    return {
        "files": [str(path) for path in found.files],
        "kind": found.kind,
        "number": int(found.t.size),
        "start_ns": int(found.t[0]),
        "end_ns": int(found.t[-1]),
        "holes_ns": [list(gap) for gap in found.holes],
        "faults": found.faults,
        **(
            {"messages": [_message(message) for message in found.messages]}
            if found.kind == "can_log"
            else {"time": found.time, "columns": [_series(series) for series in found.columns]}
        ),
    }


def _message(message: Message) -> dict[str, Any]:
    return {
        "bus": message.bus,
        "id": message.key & ~EXTENDED,
        "extended": bool(message.key & EXTENDED),
        "name": message.name,
        **_span(message.t),
        "signals": [_series(series) for series in message.signals],
    }


def _span(t: np.ndarray) -> dict[str, Any]:
    usual = rate(t)
    return {
        "number": int(t.size),
        "rate": None if math.isnan(usual) else usual,
        "start_ns": int(t[0]) if t.size else None,
        "end_ns": int(t[-1]) if t.size else None,
        "longest_gap_ns": int(np.diff(t).max()) if t.size > 1 else None,
    }


def _series(series: Series) -> dict[str, Any]:
    known = series.values.size > 0
    return {
        "name": series.name,
        "unit": series.unit,
        **_span(series.t),
        "missing": series.missing,
        "low": float(series.values.min()) if known else None,
        "high": float(series.values.max()) if known else None,
    }
