"""Sources of type table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from config.source_schema import TableSection

from .kind import Opening, recording

if TYPE_CHECKING:
    from sources.source import Channel, Source


def _make(opening: Opening, files: list[Path], channels: list[Channel]) -> Source:
    from sources.tables.table import Table

    section: TableSection = opening.section
    return Table(
        files,
        time_column=section.time.column,
        time_unit=section.time.unit,
        time_shift=section.time.shift,
        channels=channels,
        width=opening.model.width,
        report=opening.report,
        horizon=opening.loaded.config.time.horizon,
    )


TABLE = recording(_make)
