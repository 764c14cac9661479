"""Read the log of a twin; warnings about a whole recording also go to standard error."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np

from config.source_schema import SimulatorSection
from estimators.errors import ConfigError, SourceError
from estimators.events.clocks import Passed
from estimators.late import inflated
from estimators.log import TRUTH, Log
from sources.messages import FORGOTTEN, NO_BROKER, REFUSED_MESSAGE, REFUSED_TOPIC
from sources.source import LOST_FRAMES, NEVER, NO_ASSET, TRUNCATED, UNASSIGNED, UNDATED, WRONG_TIME, is_endless
from sources.tables.order import REMARKS as ORDER
from sources.tables.text import READ_AS, UNREADABLE

from ..terminal import complain
from .ingest import CLOCK_MOVED, UNSET, Ingest
from .twin import Twin, load_twin

REMARKS = (*ORDER, NEVER, TRUNCATED, CLOCK_MOVED, UNSET, READ_AS)

BROKERS = (NO_BROKER, REFUSED_MESSAGE, REFUSED_TOPIC)

ONCE_PRINTED_KEYS = (WRONG_TIME, LOST_FRAMES, UNDATED, UNREADABLE, UNASSIGNED, NO_ASSET, FORGOTTEN, *BROKERS)
"""Warnings printed once, since there may be one per row, or one with another share every few seconds."""


def remarking(report: Callable[[str, str], None]) -> Callable[[str, str], None]:
    """Return a report that also prints each warning once."""
    said: set[str] = set()

    def both(key: str, text: str) -> None:
        if key in REMARKS and text not in said:
            said.add(text)
            complain(text)
        elif key in ONCE_PRINTED_KEYS and key not in said:
            said.add(key)
            complain(text)
        report(key, text)

    return both


def read_log(twin: Twin, duration: float | None, *, blind: bool = False) -> tuple[Log, Counter[str]]:
    """Return all events of the twin's source in order of time, and counts of dropped and corrected ones.

    `duration` is the seconds to read, None for all; `blind` leaves the true states out, whatever source they come from.

    Raises:
        ConfigError: If `duration` is not positive.
        SourceError: If the source cannot be opened, has no end, or is empty.
    """
    if duration is not None and not duration > 0.0:
        raise ConfigError(f"--duration {duration:g}: must be positive")
    counts: Counter[str] = Counter()

    def count(key: str, text: str) -> None:
        counts[key] += 1

    def put(passed: Passed) -> None:
        events, settled = passed.events, passed.settled
        if blind:
            seen = events.kind != TRUTH
            events, settled = events.select(seen), settled[seen]
        if beside is not None:
            events, late = inflated(events, beside, log.newest, horizon)
            counts["inflated"] += late
        first, stale = log.extend(events, horizon, settled)
        counts["stale"] += stale
        if beside is not None:
            beside.rewind(first)
            beside.advance()

    remark = remarking(count)
    faults = twin.plan.faults()
    source = twin.open_source(remark, live=False, faults=faults)
    if duration is None and is_endless(source):
        source.close()
        raise SourceError(f"{twin.name}: its source has no end; give --duration SECONDS")
    log = Log.of(twin.model)
    horizon = round(twin.config.time.max_delay * 1e9)
    # What a late reading is inflated by is asked of the estimate when it comes.
    beside = twin.fold(log) if twin.late.inflate else None
    gap = round(twin.degraded.seconds * 1e9)
    intake = Ingest(twin.model, horizon, remark, twin.maintenance, twin.unknown_inputs, gap=gap)
    try:
        while (batch := source.read(1.0)) is not None:
            put(intake.take(batch))
            if duration is not None and log.n and log.t[log.n - 1] - log.t[0] > duration * 1e9:
                log.n = int(np.searchsorted(log.events.t, log.t[0] + round(duration * 1e9), side="right"))
                break
        else:
            put(intake.finish())
    finally:
        source.close()
    if not log.n:
        files = ", ".join(map(str, twin.plan.log_files or ()))
        place = f"--log {files}" if files else twin.loaded.places.at(("source",))
        raise SourceError(f"{place}: the source has no values for any sensor; check the channel maps")
    for fault in (item.fault for item in faults.status() if item.since is None):
        ends = f"the log ends after {log.events.seconds:.6g} s"
        complain(f"the {fault.kind} of {fault.target} begins after {fault.start:g} s and has no effect: {ends}")
    return log, +counts


def read_logs(
    twin: Twin, name: str, overrides: Mapping[str, str], count: int = 1, duration: float | None = None
) -> list[Log]:
    """Read the log of a twin, or several logs of its simulator with consecutive seeds, `duration` seconds (None: all).

    The twin was loaded from that name or path, with these overrides.

    Raises:
        NisusError: As `read_log`, or if the twin is not simulated.
    """
    if count == 1:
        return [read_log(twin, duration)[0]]
    source = twin.config.source
    if count < 1:
        raise ConfigError(f"--logs {count}: must be 1 or more")
    if not isinstance(source, SimulatorSection):
        raise ConfigError(f"--logs {count}: {twin.name} is not simulated and has one log; name recordings with --log")
    seeds = range(source.seed, source.seed + count)
    twins = (load_twin(name, overrides={**overrides, "source.seed": str(seed)}) for seed in seeds)
    return [read_log(other, duration)[0] for other in twins]
