"""Copy the history of a running twin in chunks, without holding the engine's lock for long."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from estimators.diagnostics.field_pictures import Picture
from estimators.errors import ConfigError
from estimators.log import READING, Events, Log
from estimators.snapshots import Base
from estimators.track import Track
from estimators.tuning import Tuning

from .outputs import Pull
from .running_fold import Running

END_OF_TIME = 2**62
"""Later than every event, ns."""

COPY_EVENTS = 4096
"""Events that are copied at once."""


def copy_log(
    engine: Running, tuning: Tuning, most: int | None = None, check: Callable[[], None] = lambda: None
) -> tuple[Log, Base | None]:
    """Copy the events, with the base of a fold of them; None for the prior.

    Args:
        engine: The running twin.
        tuning: The tuning of its fold.
        most: Events, the last ones; a few more, since a fold starts at a snapshot. None for all.
        check: Called before each chunk; may raise to end the copy.

    Raises:
        ConfigError: If another tuning took over meanwhile, or no reading has come.
    """
    end = engine.index_at(END_OF_TIME)
    at, base = engine.origin(0 if most is None else max(0, end - most))
    pieces = []
    for start in range(at, end, COPY_EVENTS):
        check()
        pull = engine.rows(start, min(start + COPY_EVENTS, end))
        if pull.settings is None or pull.settings[0] is not tuning or pull.first != start:
            raise ConfigError("the history changed while it was copied; try again")
        pieces.append(pull.events)
    events = Events.concat(pieces, engine.model.width)
    log = Log.resume(engine.model, base, events)
    if not (log.kind[: log.n] == READING).any():
        raise ConfigError("no reading has come yet; there is nothing to fold")
    return log, base


COPY_ROWS = 16_384
"""Rows copied at once."""


def copy_rows(engine: Running) -> Pull | None:
    """Copy all rows; None while there are none, or if a late measurement or another revision came in between."""
    cursor = engine.cursor()
    parts: list[Pull] = []
    pictures: dict[int, Picture] = {}
    try:
        while not parts or len(parts[-1].events) == COPY_ROWS:
            pull = engine.pull(cursor, COPY_ROWS)
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
