"""Sources of type merged: several recordings of one drive."""

from __future__ import annotations

import fnmatch
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from config.source_schema import CanLogSection, MergedSection, TableSection
from config.yaml_files import Key
from estimators.errors import SourceError
from sources.formats import TABLES, suffix_of
from sources.pieces import VALUES

from .can import CAN_LOG
from .kind import Kind, Opening, blamed, closed, find_recording

if TYPE_CHECKING:
    from sources.source import Channel, Source


def _open(opening: Opening) -> Source:
    from sources.merged import Merged

    section: MergedSection = opening.section
    shares: list[list[Path] | None] = [None] * len(section.parts)
    if opening.log_files is not None:
        shares = _shares(opening)
    parts = [
        PARTS[type(part)].open(replace(opening, section=part, key=(*opening.key, "parts", k), log_files=share))
        for k, (part, share) in enumerate(zip(section.parts, shares, strict=True))
        if share != []
    ]
    return Merged(parts)


def _shares(opening: Opening) -> list[list[Path] | None]:
    """Return the `--log` files of each part: by name, else tables to the table and logs to the CAN log."""
    section: MergedSection = opening.section
    shares: list[list[Path] | None] = [[] for _ in section.parts]
    for file in opening.log_files or ():
        fits = [
            k
            for k, part in enumerate(section.parts)
            if any(fnmatch.fnmatch(file.name, Path(pattern).name) for pattern in part.files)
        ]
        if not fits:
            kind = TableSection if suffix_of(file) in TABLES else CanLogSection
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


def _sections(section: MergedSection, key: Key) -> dict[Key, Any]:
    return {(*key, "parts", k): part for k, part in enumerate(section.parts)}


def _open_table(opening: Opening) -> Source:
    from sources.tables.table import Table

    section: TableSection = opening.section
    files = find_recording(opening.loaded, section, opening.key, opening.log_files)

    def table(channels: list[Channel]) -> Table:
        return Table(
            files,
            time_column=section.time.column,
            time_unit=section.time.unit,
            time_format=section.time.format,
            time_zone=section.time.zone,
            time_shift=section.time.shift,
            channels=channels,
            width=opening.model.width,
            report=opening.report,
            horizon=opening.loaded.config.time.horizon,
        )

    return blamed(opening, table)


TABLE = Kind(_open_table, kernels=(VALUES,), files=closed(_open_table))

PARTS: dict[type, Kind] = {CanLogSection: CAN_LOG, TableSection: TABLE}
"""Types that may be merged: recordings whose clocks agree."""

MERGED = Kind(_open, sections=_sections, kernels=CAN_LOG.kernels, files=closed(_open))
