"""Match a log with twins: the channels of a twin that the log has, and the reason for each that it lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from config.loader import Loaded
from config.source_schema import CanSection, TableSection
from config.yaml_files import Key
from estimators.errors import SourceError, nearest
from estimators.log import TRUTH
from estimators.model.state_space import StateSpaceModel
from sources.formats import CAN_LOGS

from .channels import channels
from .source import KEY, kind_of
from .sources.kind import find_databases

if TYPE_CHECKING:
    from sources.can.readers import BusName
    from sources.source import Channel

MAX_SIGNALS_SHOWN = 3  # Signals of a channel that are named; the others are counted


@dataclass(frozen=True)
class LogHeader:
    """Names in a log: ids of its frames by bus, or columns with their units and the texts in them.

    `time` is the column that holds the time of a table.
    """

    kind: str
    frames: frozenset[tuple[BusName, int]] = frozenset()
    columns: Mapping[str, str] | None = None
    texts: Mapping[str, Sequence[str]] | None = None
    time: str = ""


@dataclass(frozen=True)
class TwinMatch:
    """Agreement of a twin with a log.

    `found` and `missing` are lines about channels, `blocking` one reason why the twin cannot read the log at all.
    True states are in neither: a twin runs without them.
    """

    found: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    blocking: str | None = None

    @property
    def share(self) -> float:
        """Share of the sensors and inputs that the log has, 0 to 1."""
        count = len(self.found) + len(self.missing)
        return len(self.found) / count if count else 0.0

    @property
    def runs(self) -> bool:
        """Whether the twin can be run on the log."""
        return self.blocking is None and bool(self.found)


def match_log(loaded: Loaded, model: StateSpaceModel, header: LogHeader) -> TwinMatch:
    """Return how far the channels of a twin are in a log; nothing is read but the twin's databases."""
    section = loaded.config.source
    kind = kind_of(section.type)
    if not kind.takes_log:
        return TwinMatch(blocking=f"its source is a {section.type}, which reads no log")
    parts = kind.sections(section, KEY)
    fitting = {key: part for key, part in parts.items() if isinstance(part, TableSection) == (header.kind == "table")}
    if not fitting:
        reads = (
            "tables with a column for each signal" if header.kind == "can_log" else f"CAN logs ({', '.join(CAN_LOGS)})"
        )
        return TwinMatch(blocking=f"it reads {reads}")
    found: list[str] = []
    missing: list[str] = []
    blocking = None
    for key, part in parts.items():
        named = [channel for _, channel in channels(loaded, part, key, model)]
        if key not in fitting:
            missing += [
                f"{one.name}: from {'a table' if header.kind == 'can_log' else 'a CAN log'}, given too"
                for one in named
                if one.kind != TRUTH
            ]
            continue
        if isinstance(part, TableSection):
            reason, lines = _of_table(part, named, header)
        else:
            reason, lines = _of_frames(loaded, part, key, named, header)
        for channel, line in zip(named, lines, strict=True):
            if channel.kind == TRUTH:
                continue
            if line is None:
                found.append(f"{channel.name} ({_list(channel.signals)})")
            else:
                missing.append(f"{channel.name}: {line}")
        if isinstance(part, TableSection) and (missing or not found) and blocking is None:
            # A table is refused on opening if it lacks a column.
            total, count = len(found) + len(missing), len(missing)
            many = "none" if count == total else f"{total - count}"
            blocking = f"{many} of its {total} channels {'is' if total - count < 2 else 'are'} in the table"
        blocking = blocking or reason
    if not found and blocking is None:
        blocking = "none of its messages is in the log"
    return TwinMatch(tuple(found), tuple(missing), blocking)


def _of_table(part: TableSection, named: list[Channel], header: LogHeader) -> tuple[str | None, list[str | None]]:
    """Return the reason why a table cannot be read, and for each channel what it lacks."""
    from sources.tables.text import TextMatch, column_of
    from sources.units import declared_conversion, heading_unit

    columns = header.columns or {}
    texts = header.texts or {}
    names = [header.time, *columns]
    reason = None
    if part.time.column[0] not in names:
        reason = f"its time column {part.time.column[0]!r} is not in the table"

    def lacks(channel: Channel) -> str | None:
        for name in channel.needed:
            if column_of(name) not in names:
                near = nearest(column_of(name), names)
                return f"no column {column_of(name)!r}" + (f"; {near}" if near.startswith("did") else "")
            if isinstance(name, TextMatch) and name.column in texts and not set(name.texts) & set(texts[name.column]):
                return f"column {name.column!r} is never {' or '.join(map(repr, name.texts))}"
        for name, unit, wanted in zip(channel.signals, channel.units, channel.model_units, strict=True):
            try:
                declared_conversion(unit, heading_unit(name), wanted, repr(name))
            except SourceError as error:
                return str(error)
        return None

    return reason, [lacks(channel) for channel in named]


def _of_frames(
    loaded: Loaded, part: CanSection, key: Key, named: list[Channel], header: LogHeader
) -> tuple[str | None, list[str | None]]:
    """Return the reason why frames cannot be read, and for each channel what it lacks."""
    from sources.can.database import load_database
    from sources.can.decoder import find_messages, same_bus
    from sources.can.ids import KnownIds

    try:
        databases = find_databases(loaded, part, key)
    except SourceError:
        names = ", ".join(Path(item.file).name for item in part.dbc)
        return f"its database {names} is not on this machine", [None] * len(named)
    lines: list[str | None] = []
    known = KnownIds(message for path, _ in databases for message in load_database(path).messages)
    for channel in named:
        try:
            messages, bus, _ = find_messages(databases, channel)
        except SourceError as error:
            lines.append(str(error))
            continue
        ids = [known.ids(message, channel.source) for message in messages]
        there = any(one.fits(key) and same_bus(bus, where) for where, key in header.frames for one in ids)
        lines.append(None if there else f"no frame of {channel.message} ({', '.join(map(str, ids))})")
    return None, lines


def _list(names: Sequence[str]) -> str:
    more = len(names) - MAX_SIGNALS_SHOWN
    return ", ".join(names[:MAX_SIGNALS_SHOWN]) + (f" and {more} more" if more > 0 else "")
