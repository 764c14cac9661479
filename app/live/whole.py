"""All rows of what runs, copied in pieces, so that a long history does not hold the engine's lock for long."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimators.diagnostics.field_pictures import Picture
from estimators.log import Events
from estimators.track import Track

from .interface import Running
from .outputs import Pull

ROWS = 16_384
"""Rows copied at once."""


def whole(engine: Running) -> Pull | None:
    """All rows; None while there are none, or if a late reading or another revision came in between."""
    cursor = engine.cursor()
    parts: list[Pull] = []
    pictures: dict[int, Picture] = {}
    try:
        while not parts or len(parts[-1].events) == ROWS:
            pull = engine.pull(cursor, ROWS)
            if parts and (pull.fresh or pull.first != parts[-1].first + len(parts[-1].events)):
                return None
            parts.append(pull)
            pictures |= {picture.before: picture for picture in pull.pictures}
    finally:
        engine.release(cursor)
    if not len(parts[0].events):
        return None
    events = Events.concat([part.events for part in parts], engine.model.width)
    columns = zip(*(part.track for part in parts), strict=True)
    track = Track(*(np.concatenate(column) for column in columns))
    return replace(parts[0], events=events, track=track, pictures=[pictures[index] for index in sorted(pictures)])
