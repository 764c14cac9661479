"""Whether the recordings and DBC files that a twin reads are here, without opening any."""

from __future__ import annotations

from config.loader import Loaded
from config.source_schema import CanLogSection, CanSection, RecordingSection
from estimators.errors import SourceError

from .files import find_databases, find_recording
from .source import KEY
from .sources.registry import SOURCES


def missing(loaded: Loaded) -> str | None:
    """What is not here, in one line with the remedy; None if all is."""
    section = loaded.config.source
    try:
        for key, part in SOURCES[section.type].sections(section, KEY).items():
            if isinstance(part, RecordingSection):
                find_recording(loaded, part, key, None)
            if isinstance(part, CanSection | CanLogSection):
                find_databases(loaded, part, key)
    except SourceError as error:
        return str(error)
    return None
