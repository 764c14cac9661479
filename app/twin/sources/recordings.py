"""Sources of type merged: several recordings of one drive."""

from __future__ import annotations

import fnmatch
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from config.source_schema import CanLogSection, MergedSection, TableSection
from config.yaml_files import Key
from estimators.errors import SourceError
from estimators.events.clocks import Passed
from estimators.log import BEFORE, Events
from sources.merged import MemorySource, Merged
from sources.pieces import VALUES
from sources.source import Source, span_of

from ..ingest import Ingest
from .can import CAN_LOG
from .kind import Kind, Opening, blamed, closed, failure, find_recording, matching

if TYPE_CHECKING:
    from config.fields import Section
    from sources.source import Channel
    from sources.tables.dialect import Dialect
    from sources.tables.times import TimeColumn


def _open(opening: Opening) -> Source:
    section: MergedSection = opening.section
    shares: list[list[Path] | None] = [None] * len(section.parts)
    if opening.log_files is not None:
        shares = _shares(opening)
    parts = [
        PARTS[type(part)].open(replace(opening, section=part, key=(*opening.key, "parts", k), log_files=share))
        for k, (part, share) in enumerate(zip(section.parts, shares, strict=True))
        if share != []
    ]
    horizon = round(opening.loaded.config.time.max_delay * 1e9)
    return Merged([OwnClock(part, Ingest(opening.model, horizon, opening.report)) for part in parts])


class OwnClock(Source):
    """Recording with a clock of its own, which is checked and corrected before its events meet those of others.

    A clock that was set is known only some events later, so the recording is read to its end first.
    """

    live = False

    def __init__(self, source: Source, intake: Ingest) -> None:
        self._source, self._intake = source, intake
        self._passed: list[Passed] = []
        self._checked: MemorySource | None = None

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time of the source, ns."""
        return span_of(self._source)

    def read(self, timeout: float) -> Events | None:
        """Return the next events; none while the source is read; None at the end."""
        if self._checked is not None:
            return self._checked.read(timeout)
        batch = self._source.read(timeout)
        passed = self._intake.finish() if batch is None else self._intake.take(batch)
        self._passed.append(passed)
        if batch is None:
            events = Events.concat([passed.events for passed in self._passed], 0)
            # Events that were held come late; all others stay in the order in which they were recorded.
            held = np.concatenate([passed.settled for passed in self._passed])
            at = np.where(held, events.t, np.maximum.accumulate(np.where(held, BEFORE, events.t)))
            self._checked, self._passed = MemorySource(events.select(np.argsort(at, kind="stable"))), []
        return passed.events.select(slice(0, 0))

    def close(self) -> None:
        """Close the source."""
        self._source.close()


def _shares(opening: Opening) -> list[list[Path] | None]:
    """Return the `--log` files of each part: by name, else tables to the table and logs to the CAN log."""
    from sources.inspect import is_table  # Here, not above: few twins are merged of files that are replaced.

    section: MergedSection = opening.section
    shares: list[list[Path] | None] = [[] for _ in section.parts]
    for file in opening.log_files or ():
        fits = [
            k
            for k, part in enumerate(section.parts)
            if any(fnmatch.fnmatch(file.name, Path(pattern).name) for pattern in part.files)
        ]
        if not fits:
            kind = TableSection if is_table(file) else CanLogSection
            fits = [k for k, part in enumerate(section.parts) if isinstance(part, kind)]
        if len(fits) != 1:
            raise SourceError(
                f"--log {file}: {len(fits)} parts of {opening.loaded.places.at(('source', 'parts'))} could read it; "
                "give it the name of the file that it replaces"
            )
        share = shares[fits[0]]
        assert share is not None
        share.append(file)
    return shares


def _sections(section: MergedSection, key: Key) -> dict[Key, Section]:
    return {(*key, "parts", k): part for k, part in enumerate(section.parts)}


def _open_table(opening: Opening) -> Source:
    from sources.tables.dialect import dialect_of
    from sources.tables.table import Table
    from sources.tables.times import TimeColumn

    section: TableSection = opening.section
    own = section.time
    name, *clock = own.column
    time = TimeColumn(name, own.unit, own.format, own.zone, clock[0] if clock else None, own.date, own.shift)
    try:
        dialect = dialect_of(section.heading, section.delimiter, section.decimal, section.skip, section.sheet)
    except SourceError as error:
        raise failure(opening.loaded, opening.key, str(error), ".") from None
    if opening.of_assets or (section.follow and opening.live and opening.log_files is None):
        return _follow(opening, section, time, dialect)
    files = find_recording(opening.loaded, section, opening.key, opening.log_files)

    def table(channels: list[Channel]) -> Table:
        return Table(
            files,
            time=time,
            channels=channels,
            width=opening.model.width,
            report=opening.report,
            horizon=opening.loaded.config.time.max_delay,
            dialect=dialect,
        )

    return blamed(opening, table)


def _follow(opening: Opening, section: TableSection, time: TimeColumn, dialect: Dialect) -> Source:
    from sources.tables.follow import FollowedTable

    recorded = [] if section.follow else find_recording(opening.loaded, section, opening.key, None)
    asset = getattr(section, "asset", None)

    def files() -> list[Path]:
        found = [path for pattern in section.files for path in matching(opening.loaded, section, pattern)]
        return recorded or list(dict.fromkeys(found))

    width, report = opening.model.width, opening.report

    def table(channels: list[Channel]) -> FollowedTable:
        ends = not section.follow
        return FollowedTable(
            files, time=time, channels=channels, width=width, report=report, asset=asset, ends=ends, dialect=dialect
        )

    return blamed(opening, table)


TABLE = Kind(_open_table, kernels=(VALUES,), files=closed(_open_table))

PARTS: dict[type, Kind] = {CanLogSection: CAN_LOG, TableSection: TABLE}
"""Types that may be merged: recordings whose clocks agree."""

MERGED = Kind(_open, sections=_sections, kernels=CAN_LOG.kernels, files=closed(_open))
