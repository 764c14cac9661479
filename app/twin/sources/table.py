"""Sources of type table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from config.source_schema import TableSection

from ..files import find_recording
from .kind import Kind, Opening, blamed

if TYPE_CHECKING:
    from sources.source import Source


def _open(opening: Opening) -> Source:
    from sources.tables.table import Table

    section: TableSection = opening.section
    files = find_recording(opening.loaded, section, opening.key, opening.log_files)
    return blamed(
        opening,
        lambda channels: Table(
            files,
            time_column=section.time.column,
            time_unit=section.time.unit,
            time_shift=section.time.shift,
            channels=channels,
            width=opening.model.width,
            report=opening.report,
            horizon=opening.loaded.config.time.horizon,
        ),
    )


TABLE = Kind(_open)
