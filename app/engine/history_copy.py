"""Copy the history of a running twin in chunks, without holding the engine's lock for long."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from estimators.errors import ConfigError
from estimators.log import READING, Events, Log
from estimators.snapshots import Base
from estimators.track import Track
from estimators.tuning import Tuning

from .copies import MAX_PULL_ROWS, Cursor, Pull
from .running_fold import Running


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
    end = engine.end()
    at, base = engine.origin(0 if most is None else max(0, end - most))
    pieces = []
    for start in range(at, end, MAX_PULL_ROWS):
        check()
        pull = engine.rows(start, min(start + MAX_PULL_ROWS, end))
        if pull.settings is None or pull.settings[0] is not tuning or pull.first != start:
            raise ConfigError("the history changed while it was copied; try again")
        pieces.append(pull.events)
    events = Events.concat(pieces, engine.model.width)
    log = Log.resume(engine.model, base, events)
    if not (log.events.kind == READING).any():
        raise ConfigError("no reading has come yet; there is nothing to fold")
    return log, base


def copy_rows(engine: Running) -> Pull | None:
    """Copy all rows; None while there are none."""
    cursor = engine.cursor()
    try:
        found = joined(follow(engine, cursor), engine.model.width)
    finally:
        engine.release(cursor)
    return found if len(found.events) else None


def last_written(index: np.ndarray) -> np.ndarray:
    """Return which rows, by index in the order of writing (n,), are valid: one written again cuts off later ones."""
    later = np.minimum.accumulate(index[::-1])[::-1]
    return np.append(index[:-1] < later[1:], np.ones(min(1, index.size), bool))


def follow(source: Any, cursor: Cursor, size: int | None = None, *, align: int = 1) -> Iterator[Pull]:
    """Pull from an engine, or what has the same rows, until none are left: at least once, `size` rows at a time.

    Rows are pulled again if the cursor is moved back meanwhile. For `align` see `Running.pull`.
    """
    size = size or MAX_PULL_ROWS
    while True:
        pull = source.pull(cursor, size, align=align)
        yield pull
        if len(pull.events) < size and cursor.next == pull.first + len(pull.events):
            return


def joined(pulls: Iterable[Pull], width: int) -> Pull:
    """Return the rows of several pulls, of which the first is fresh, as one; for `width` see `Events`.

    If another revision begins meanwhile its rows are returned; rows that a late measurement rewrote are the later ones.
    Notices are those of all pulls.
    """
    parts: list[Pull] = []
    notices = []
    for pull in pulls:
        notices += pull.notices
        parts = [pull] if pull.fresh else [*parts, pull]
    first = parts[0].first
    events = Events.concat([part.events for part in parts], width)
    columns = zip(*(part.track for part in parts), strict=True)
    track = Track(*(np.concatenate(column) for column in columns))
    index = np.concatenate([part.first + np.arange(len(part.events)) for part in parts])
    kept = last_written(index)
    if not kept.all():
        events, track = events.select(kept), track.select(kept)
    pictures = {picture.before: picture for part in parts for picture in part.pictures}
    return replace(
        parts[-1], fresh=True, first=first, events=events, track=track, notices=notices,
        pictures=[pictures[k] for k in sorted(pictures)],
    )  # fmt: skip
