"""Sources of type can_log, and recordings of those of type can."""

from __future__ import annotations

from typing import TYPE_CHECKING

from config.source_schema import CanSection
from estimators.errors import SourceError
from sources.pieces import FRAMES, VALUES

from ..files import find_databases, find_recording
from .kind import Kind, Opening, about, blamed, closed

if TYPE_CHECKING:
    from sources.can.decoder import Decoder
    from sources.source import Source


def make_decoder(opening: Opening) -> Decoder:
    """What takes the section's channels from its frames.

    Raises:
        SourceError: With file and line, if a database lacks a message or signal.
    """
    from sources.can.decoder import Decoder

    databases = find_databases(opening.loaded, opening.section, opening.key)
    width, report = opening.model.width, opening.report
    return blamed(opening, lambda channels: Decoder(databases, channels, width=width, report=report))


def open_can_log(opening: Opening) -> Source:
    """Open the recorded frames."""
    from sources.can.log import CanLog

    files = find_recording(opening.loaded, opening.section, opening.key, opening.log_files)
    decoder = make_decoder(opening)
    try:
        return CanLog(files, decoder, report=opening.report)
    except SourceError as error:
        if opening.log_files is not None:
            raise
        where = "recording" if isinstance(opening.section, CanSection) else "files"
        raise about(opening.loaded, (*opening.key, where), str(error)) from None


CAN_LOG = Kind(open_can_log, kernels=(FRAMES, VALUES), files=closed(open_can_log))
