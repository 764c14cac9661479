"""Overview of a log for the page: its signals with figures, curves and proposed roles; and a draft of a twin from it.

`overview` and `draft` run in a reader process, since they hold all values of the log.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from estimators.errors import ConfigError, SourceError
from sources.can.database import load_database
from sources.can.ids import KnownIds, shown_id
from sources.can.readers import BusName
from sources.formats import files_of
from sources.inspect import Message, RecordingContents, SignalSeries, inspect_recordings, is_table
from sources.tables.rows import names_of
from sources.tables.times import TimeColumn

from ..result import JsonObject
from .advice.draft import write_draft
from .advice.draft_fit import DraftStep, fit_plan
from .advice.plan import OMITTED, SENSOR, STATE, DraftPlan, Roles, SignalRole, plan
from .advice.signals import rate_of, signal

CURVE_BUCKETS = 300
"""Buckets of a curve, each with its lowest and highest value; a shorter series keeps all its values."""

ALL_BUCKETS = 400_000
"""Buckets of all curves of a log; with more than 1,333 signals each has fewer."""

MIN_CURVE_BUCKETS = 40

MAX_FAULTS = 8  # Faults of a log that are listed; the others are counted

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
    """A database that could describe the log: ids of the log in it, or why it cannot be read."""

    file: str
    ids: int
    error: str | None = None


@dataclass(frozen=True)
class LogOverview:
    """Contents of a log; `curves` belong to `signals`. `choices` are columns that may hold the time of a table.

    `roles` are those that a draft proposes, each with its reason; None until they are known.
    `needs` names what is missing before the log can be read: "time" or "database". `keys` are buses and ids of frames,
    `used` the databases that describe them.
    """

    file: str
    kind: str
    number: int = 0
    start_ns: int = 0
    seconds: float = 0.0
    gaps: int = 0
    ids: int = 0
    signals: list[SignalOverview] = field(default_factory=list)
    frames: list[FrameOverview] = field(default_factory=list)
    databases: list[DatabaseOverview] = field(default_factory=list)
    used: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    texts: dict[str, list[str]] = field(default_factory=dict)
    time: str = ""
    choices: list[str] = field(default_factory=list)
    needs: str | None = None
    roles: list[tuple[str, str]] | None = None
    keys: list[tuple[BusName, int]] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)

    def as_json(self) -> JsonObject:
        """Return the overview without paths, keys and curves."""
        hidden = ("file", "used", "keys", "curves", "start_ns")
        parts = {key: value for key, value in vars(self).items() if key not in hidden}
        lists = {key: [asdict(item) for item in parts[key]] for key in ("signals", "frames", "databases")}
        return parts | lists | {"start": self.start_ns * 1e-9}


def overview(
    path: Path, databases: Sequence[Path] | None, offered: Sequence[Path], time: TimeColumn | None
) -> Iterator[LogOverview]:
    """Yield the overview of a log, in a reader process.

    Args:
        path: The log.
        databases: DBC files that describe a CAN log; None takes those of `offered` in the log's folder that know one of
            its ids.
        offered: DBC files whose ids are compared with those of the log.
        time: Time column of a table; None, or an empty name, searches for one.

    Raises:
        SourceError: If the log cannot be read.
    """
    files = files_of(path)
    if all(map(is_table, files)):
        yield from _of_table(path, files, time or TimeColumn(""))
        return
    found = inspect_recordings(files)
    ids = {message.key for message in found.messages}
    known = [_database(file, ids) for file in dict.fromkeys((*(databases or ()), *offered))]
    if databases is None:
        dropped = [one for one in known if one.ids and Path(one.file).parent == path.parent]
        used = [Path(one.file) for one in sorted(dropped, key=lambda one: -one.ids)]
    else:
        broken = {one.file for one in known if one.error}
        used = [file for file in databases if str(file) not in broken]
    if used:
        found = inspect_recordings(files, [(file, None) for file in used])
    yield from _proposed(found, _of(found, len(ids), known, [str(file) for file in used]))


def _proposed(found: RecordingContents, described: LogOverview) -> Iterator[LogOverview]:
    """Yield an overview, then with the roles that a draft proposes, which take longer."""
    yield described
    if described.signals:
        try:
            roles = [(proposed_role(one), one.reason) for one in plan(found, Roles()).roles]
        except ConfigError as error:
            roles = [("", str(error).removeprefix(f"{found.files[0]}: "))] * len(described.signals)
        yield replace(described, roles=roles)


def proposed_role(one: SignalRole) -> str:
    """Return the role of a signal on the page: that of a sensor is "state" if it has a state of its own."""
    if one.role == OMITTED:
        return ""
    return STATE if one.role == SENSOR and one.reason.partition("; ")[0] == f"measures {one.name}" else one.role


def draft(
    path: Path, databases: Sequence[Path], time: TimeColumn, name: str, roles: Mapping[str, Sequence[str]]
) -> Iterator[DraftStep]:
    """Yield the steps of a draft, which is written beside the log; in a reader process.

    Args:
        path: The log.
        databases: DBC files of a CAN log.
        time: Time column of a table.
        name: Name of the twin.
        roles: Signals of each role, by the fields of `Roles`.

    Raises:
        ConfigError: If a role does not apply.
        SourceError: If the log cannot be read.
    """
    yield DraftStep("reading the log")
    buses: list[tuple[Path, BusName]] = [(file, None) for file in databases]
    found = inspect_recordings(files_of(path), buses, time)
    yield DraftStep("estimating noises, time constants and gains")
    drafted = yield from fit_plan(plan(found, Roles(**{role: tuple(names) for role, names in roles.items()})))
    yield DraftStep("writing the twin")
    written = write_draft(drafted, found, name, path.parent, buses)
    yield DraftStep("", str(written.yaml_path), _summary(drafted))


def _summary(drafted: DraftPlan) -> str:
    sensors = sum(len(item.sensors) for item in drafted.states)
    counted = f"{len(drafted.states)} states, {sensors} sensors, {len(drafted.inputs)} inputs"
    return counted if drafted.check is None else f"{counted}; {drafted.check.words}"


def _of_table(path: Path, files: Sequence[Path], time: TimeColumn) -> Iterator[LogOverview]:
    """Yield the overview of a table; if its time is not known, its columns."""
    names = list(dict.fromkeys(names_of(files[0])))
    try:
        found = inspect_recordings(files, time=time)
    except SourceError as error:
        if not names:
            raise
        text = str(error).removeprefix(f"{path}: ")
        yield LogOverview(str(path), "table", faults=[text], time=time.name, choices=names, needs="time")
        return
    yield from _proposed(found, _of(found, choices=names))


def _database(file: Path, ids: set[int]) -> DatabaseOverview:
    try:
        messages = load_database(file).messages
    except SourceError as error:
        return DatabaseOverview(str(file), 0, str(error).removeprefix(f"{file}: "))
    known = KnownIds(messages)
    return DatabaseOverview(str(file), sum(known.find(key) is not None for key in ids))


def _of(
    found: RecordingContents,
    ids: int = 0,
    databases: Sequence[DatabaseOverview] = (),
    used: Sequence[str] = (),
    choices: Sequence[str] = (),
) -> LogOverview:
    start, end = int(found.t[0]), int(found.t[-1])
    named = [(message.name or "", one) for message in found.messages for one in message.signals]
    named += [(group_of(one.name), one) for one in found.columns]
    kept = [(group, one) for group, one in named if one.t.size]
    buckets = min(CURVE_BUCKETS, max(MIN_CURVE_BUCKETS, ALL_BUCKETS // max(len(kept), 1)))
    faults = found.faults[:MAX_FAULTS]
    if len(found.faults) > MAX_FAULTS:
        faults.append(f"and {len(found.faults) - MAX_FAULTS} more faults")
    if empty := len(named) - len(kept) - sum(one.name in found.texts for _, one in named):
        faults.append(f"{empty} signals without a value are left out")
    return LogOverview(
        file=str(found.files[0]),
        kind=found.kind,
        number=int(found.t.size),
        start_ns=start,
        seconds=(end - start) * 1e-9,
        gaps=len(found.holes),
        ids=ids,
        signals=[_signal(group, one) for group, one in kept],
        frames=[_frames(message) for message in found.messages if message.name is None],
        databases=list(databases),
        used=list(used),
        faults=faults,
        texts={
            name: [f"{text} ({count:,})" for text, count in counts.most_common(8)]
            for name, counts in found.texts.items()
        },
        time=found.time.name,
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
