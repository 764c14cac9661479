"""Overview of a log for the page: its signals with figures, curves and proposed roles; and a draft of a twin from it.

`overview` and `draft` run in a reader process, since they hold all values of the log.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import PydanticCustomError

from config.source_schema import known_zone
from estimators.diagnostics.repeats import find_repeats
from estimators.errors import ConfigError, SourceError
from sources.can.database import load_database
from sources.can.ids import KnownIds, shown_id
from sources.can.readers import BusName
from sources.formats import files_of
from sources.inspect import (
    Message,
    RecordingContents,
    SignalSeries,
    holes,
    inspect_recordings,
    is_table,
    quality_conditions,
)
from sources.tables.dialect import DETECTED, Dialect, dialect_of
from sources.tables.rows import names_of
from sources.tables.times import SERIAL_DAYS, UNITS, TimeColumn

from ..format_time import duration_text
from ..result import JsonObject
from .advice.draft import undecided_lines, write_draft
from .advice.draft_fit import DraftStep, fit_plan
from .advice.plan import OMITTED, SENSOR, STATE, DraftPlan, Roles, SignalRole, plan
from .advice.signals import rate_of, signal, signals

CURVE_BUCKETS = 300
"""Buckets of a curve, each with its lowest and highest value; a shorter series keeps all its values."""

ALL_BUCKETS = 400_000
"""Buckets of all curves of a log; with more than 1,333 signals each has fewer."""

MIN_CURVE_BUCKETS = 40

MAX_LISTED, MAX_TEXTS_SHOWN = 5, 8  # Gaps and faults, and texts of a column, that are listed; the others are counted

MIN_LONG_NS = 7_200_000_000_000  # Time from which on hours and days are shown

Reading = tuple[TimeColumn, Dialect]
"""How a table is read: its time column, and how it is written."""

Curve = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Seconds from the start of the log, lowest and highest value, float32, (n,)."""


@dataclass(frozen=True)
class SignalOverview:
    """A signal or column: `group` is its message, struct or array, `kind` that of `advice.signals.Signal`."""

    name: str
    group: str
    unit: str
    number: int
    missing: int
    rate: float | None
    low: float | None
    high: float | None
    kind: str


@dataclass(frozen=True)
class FrameOverview:
    """Frames of one id that no database describes."""

    bus: str
    id: str
    number: int
    rate: float | None


@dataclass(frozen=True)
class DatabaseOverview:
    """A database that could describe the log: ids of the log in it, or why it cannot be read; `used` if it does."""

    file: Path
    ids: int
    error: str | None = None
    used: bool = False


@dataclass(frozen=True)
class LogOverview:
    """Contents of a log; `curves` belong to `signals`. `choices` are columns that may hold the time of a table.

    `roles` are those that a draft proposes, each with its reason; None until they are known.
    `needs` names what is missing before the log can be read: "time" or "database". `keys` are buses and ids of frames.
    """

    file: str
    kind: str
    number: int = 0
    start: float = 0.0
    seconds: float = 0.0
    ids: int = 0
    signals: list[SignalOverview] = field(default_factory=list)
    frames: list[FrameOverview] = field(default_factory=list)
    databases: list[DatabaseOverview] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    facts: list[str] = field(default_factory=list)
    texts: dict[str, list[str]] = field(default_factory=dict)
    time: str = ""
    unit: str = "s"
    choices: list[str] = field(default_factory=list)
    needs: str | None = None
    roles: list[tuple[str, str]] | None = None
    keys: list[tuple[BusName, int]] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)

    def as_json(self) -> JsonObject:
        """Return the overview without files, keys and curves."""
        hidden = ("file", "databases", "keys", "curves")
        parts = {key: value for key, value in vars(self).items() if key not in hidden}
        lists = {key: [asdict(item) for item in parts[key]] for key in ("signals", "frames")}
        return parts | lists


def how_to_read(options: Any, time: str = "", sign: str = "") -> Reading:
    """Return time column and dialect of a request, or of options: `sign`, `time` begin those of unit, format and zone.

    Raises:
        NisusError: If one of them is wrong.
    """
    unit, form, zone = (getattr(options, f"{time}{key}") for key in ("unit", "format", "zone"))
    units, option = [*UNITS, *SERIAL_DAYS], sign + time.replace("_", "-")
    if unit not in units:
        raise ConfigError(f"{option}unit {unit}: is no unit of time; choose from {', '.join(units)}")
    try:
        zone = zone and known_zone(zone)
    except PydanticCustomError as error:
        raise ConfigError(f"{option}zone {zone}: {error.message()}") from None
    dialect = (options.heading, options.delimiter, options.decimal, options.skip, options.sheet)
    return TimeColumn(options.time or "", unit, form, zone), dialect_of(*dialect, sign)


def overview(
    path: Path, databases: Sequence[Path] | None, offered: Sequence[Path], how: Reading | None = None
) -> Iterator[LogOverview]:
    """Yield the overview of a log, in a reader process.

    Args:
        path: The log.
        databases: DBC files that describe a CAN log; None takes those of `offered` in the log's folder that know one of
            its ids.
        offered: DBC files whose ids are compared with those of the log.
        how: Time column and dialect of a table; None, or an empty name, searches for the time.

    Raises:
        SourceError: If the log cannot be read.
        ConfigError: After the overview, if no roles can be proposed.
    """
    files, how = files_of(path), how or (TimeColumn(""), DETECTED)
    if all(map(is_table, files)):
        yield from _of_table(path, files, how)
        return
    found = inspect_recordings(files, (), *how)
    ids = {message.key for message in found.messages}
    known = [_database(file, ids) for file in dict.fromkeys((*(databases or ()), *offered))]
    if databases is None:
        known.sort(key=lambda one: -one.ids)
        used = [one.file for one in known if one.ids and one.file.parent == path.parent]
    else:
        used = [one.file for one in known if not one.error and one.file in databases]
    if used:
        found = inspect_recordings(files, [(file, None) for file in used], *how)
    yield from _proposed(found, _of(found, len(ids), [replace(one, used=one.file in used) for one in known]))


def _proposed(found: RecordingContents, described: LogOverview) -> Iterator[LogOverview]:
    """Yield an overview, then with the roles that a draft proposes, which take longer."""
    yield described
    if described.signals:
        yield replace(described, roles=[(proposed_role(one), one.reason) for one in plan(found, Roles()).roles])


def proposed_role(one: SignalRole) -> str:
    """Return the role of a signal on the page: that of a sensor is "state" if it has a state of its own."""
    if one.role == OMITTED:
        return ""
    return STATE if one.role == SENSOR and one.reason.partition("; ")[0] == f"measures {one.name}" else one.role


def draft(
    path: Path, databases: Sequence[Path], how: Reading, name: str, roles: Mapping[str, Sequence[str]]
) -> Iterator[DraftStep]:
    """Yield the steps of a draft, which is written beside the log; in a reader process.

    Args:
        path: The log.
        databases: DBC files of a CAN log.
        how: Time column and dialect of a table.
        name: Name of the twin.
        roles: Signals of each role, by the fields of `Roles`.

    Raises:
        ConfigError: If a role does not apply.
        SourceError: If the log cannot be read.
    """
    yield DraftStep("reading the log")
    buses: list[tuple[Path, BusName]] = [(file, None) for file in databases]
    found = inspect_recordings(files_of(path), buses, *how)
    yield DraftStep("estimating noises, time constants and gains")
    drafted = yield from fit_plan(plan(found, Roles(**{role: tuple(names) for role, names in roles.items()})))
    yield DraftStep("writing the twin")
    written = write_draft(drafted, found, name, path.parent, buses)
    yield DraftStep("", str(written.yaml_path), _summary(drafted))


def _summary(drafted: DraftPlan) -> str:
    counted = f"{len(drafted.states)} states, {len(drafted.sensors)} sensors, {len(drafted.inputs)} inputs"
    return counted if drafted.check is None else f"{counted}; {drafted.check.words}"


def _of_table(path: Path, files: Sequence[Path], how: Reading) -> Iterator[LogOverview]:
    """Yield the overview of a table; if its time is not known, its columns."""
    time, dialect = how
    names = list(dict.fromkeys(names_of(files[0], "", dialect)))
    try:
        found = inspect_recordings(files, (), *how)
    except SourceError as error:
        if not names:
            raise
        text = str(error).removeprefix(f"{path}: ")
        yield LogOverview(
            str(path), "table", faults=[text], time=time.name, unit=time.unit, choices=names, needs="time"
        )
        return
    yield from _proposed(found, _of(found, choices=names))


def _database(file: Path, ids: set[int]) -> DatabaseOverview:
    try:
        messages = load_database(file).messages
    except SourceError as error:
        return DatabaseOverview(file, 0, str(error).removeprefix(f"{file}: "))
    known = KnownIds(messages)
    return DatabaseOverview(file, sum(known.find(key) is not None for key in ids))


def facts_of(found: RecordingContents) -> list[str]:
    """Return gaps, repeats, time and texts of a recording in words, a line each."""
    start = int(found.t[0])
    gaps = [f"{duration(b - a)} at {duration(a - start)}" for a, b in found.holes[:MAX_LISTED]]
    more = f", and {len(found.holes) - MAX_LISTED} more" if len(found.holes) > MAX_LISTED else ""
    lines = [f"{len(found.holes)} gaps: {', '.join(gaps)}{more}" if gaps else "no gaps of all signals together"]
    lines += _own_gaps(found) + _repeats(found)
    if found.kind == "table":
        zone = f", local time of {found.time.zone}" if found.time.zone else ""
        lines.append(f"time: column {found.time.label}{zone}")
        lines += [
            f"{name}: text: {', '.join(f'{text} ({count:,})' for text, count in counts.most_common(MAX_TEXTS_SHOWN))}"
            for name, counts in found.texts.items()
        ]
        if found.by:
            lines.append(f"{found.by} names the source of each row; a twin reads them with landmark_column: {found.by}")
        lines += quality_conditions(found)
    return lines


def _own_gaps(found: RecordingContents) -> list[str]:
    """Return the gaps of single messages and columns, and of signals where their flag of validity is 1."""
    of_all = set(found.holes)
    named: dict[tuple[tuple[int, int], ...], list[str]] = {}
    for one in signals(found):
        own = tuple(hole for hole in holes(one.series.t) if hole not in of_all)
        if own:
            name = one.series.name if one.message is None else f"{one.message}.{one.series.name}"
            named.setdefault(own, []).append(name + (f" where {one.valid} is 1" if one.valid else ""))
    longest = sorted(named, key=lambda own: -max(end - begin for begin, end in own))
    lines = []
    for own in longest[:MAX_LISTED]:
        begin, end = max(own, key=lambda hole: hole[1] - hole[0])
        others = f" and {len(named[own]) - 1} more" if len(named[own]) > 1 else ""
        lines.append(
            f"{named[own][0]}{others}: {len(own)} gap{'s' * (len(own) > 1)}, the longest {duration(end - begin)} at "
            f"{duration(begin - int(found.t[0]))}"
        )
    return lines + ([f"and gaps of {len(longest) - MAX_LISTED} more groups of signals"] if longest[MAX_LISTED:] else [])


def _repeats(found: RecordingContents) -> list[str]:
    """Return the signals whose rows repeat or interpolate values, and those of which this cannot be decided."""
    some = [(one.name, find_repeats(one.series.t, one.series.values)) for one in signals(found) if one.kind == "signal"]
    lines = [f"{name}: {one.reason}" for name, one in some if one.found]
    more = [f"and {len(lines) - MAX_LISTED} more signals with repeats"] * (len(lines) > MAX_LISTED)
    return lines[:MAX_LISTED] + more + undecided_lines(some)


def duration(ns: int) -> str:
    """Return a time in seconds, and one of hours in hours or days."""
    return f"{ns * 1e-9:.1f} s" if ns < MIN_LONG_NS else duration_text(ns * 1e-9)


def listed_faults(found: RecordingContents) -> list[str]:
    """Return what is wrong with a recording, and what was assumed to read it."""
    more = len(found.faults) - MAX_LISTED
    return found.faults[:MAX_LISTED] + [f"and {more} more faults"] * (more > 0)


def _of(
    found: RecordingContents,
    ids: int = 0,
    databases: Sequence[DatabaseOverview] = (),
    choices: Sequence[str] = (),
) -> LogOverview:
    start, end = int(found.t[0]), int(found.t[-1])
    named = [(message.name or "", one) for message in found.messages for one in message.signals]
    named += [(group_of(one.name), one) for one in found.columns]
    kept = [(group, one) for group, one in named if one.t.size]
    buckets = min(CURVE_BUCKETS, max(MIN_CURVE_BUCKETS, ALL_BUCKETS // max(len(kept), 1)))
    faults = listed_faults(found)
    if empty := len(named) - len(kept) - sum(one.name in found.texts for _, one in named):
        faults.append(f"{empty} signals without a value are left out")
    return LogOverview(
        file=str(found.files[0]),
        kind=found.kind,
        number=int(found.t.size),
        start=start * 1e-9,
        seconds=(end - start) * 1e-9,
        facts=facts_of(found),
        ids=ids,
        signals=[_signal(group, one) for group, one in kept],
        frames=[_frames(message) for message in found.messages if message.name is None],
        databases=list(databases),
        faults=faults,
        texts={name: list(counts) for name, counts in found.texts.items()},
        time=found.time.name,
        unit=found.time.unit,
        choices=list(choices),
        needs="database" if found.kind == "can_log" and not kept else None,
        keys=[(message.bus, message.key) for message in found.messages],
        curves=[curve(one.t, one.values, start, end, buckets) for _, one in kept],
    )


def group_of(name: str) -> str:
    """Return the struct or array of a column: `meas` of `meas.Voltage`, `t2m` of `t2m[3,5]`."""
    return name.partition("[")[0] if name.endswith("]") and "," in name else name.rpartition(".")[0]


def _signal(group: str, one: SignalSeries) -> SignalOverview:
    described = signal(group or None, one)
    rate = described.rate if math.isfinite(described.rate) else None
    low, high = float(one.values.min()), float(one.values.max())
    return SignalOverview(one.name, group, one.unit, int(one.t.size), one.missing, rate, low, high, described.kind)


def _frames(message: Message) -> FrameOverview:
    rate = rate_of(message.t)
    bus = "" if message.bus is None else str(message.bus)
    return FrameOverview(bus, shown_id(message.key), message.t.size, rate if math.isfinite(rate) else None)


def curve(t: np.ndarray, values: np.ndarray, start: int, end: int, buckets: int = CURVE_BUCKETS) -> Curve:
    """Return a series as it is, or the extremes in equal intervals of the log; an empty interval is left out."""
    seconds = (t - start) * 1e-9
    if t.size <= 2 * buckets:
        return seconds.astype(np.float32), values.astype(np.float32), values.astype(np.float32)
    bucket = np.minimum(((t - start) * (buckets / max(end - start, 1))).astype(np.int64), buckets - 1)
    first = np.flatnonzero(np.diff(bucket, prepend=-1))
    low, high = np.minimum.reduceat(values, first), np.maximum.reduceat(values, first)
    return seconds[first].astype(np.float32), low.astype(np.float32), high.astype(np.float32)
