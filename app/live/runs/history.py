"""All that a running twin holds, or the last of it, as a log of its own to be folded beside it."""

from __future__ import annotations

from collections.abc import Callable

from estimators.errors import ConfigError
from estimators.log import READING, Events, Log
from estimators.snapshots import Base
from estimators.tuning import Tuning

from ..interface import Running
from .window import ALL

PIECE = 4096
"""Events that are copied at once, so that the engine never waits for long."""


def history(
    engine: Running, tuning: Tuning, most: int | None = None, go: Callable[[], bool] = lambda: True
) -> tuple[Log, Base | None]:
    """Copy the events, and where a fold of them starts; None for the prior.

    Args:
        engine: Whose.
        tuning: With which they were folded.
        most: How many, the last; a few more, since a fold starts at a snapshot. None for all.
        go: Whether to go on with the next piece.

    Raises:
        ConfigError: If another tuning took over meanwhile, or no reading has come.
    """
    end = engine.index_at(ALL)
    at, base = engine.origin(0 if most is None else max(0, end - most))
    pieces = []
    for start in range(at, end, PIECE):
        pull = engine.rows(start, min(start + PIECE, end))
        if engine.folded_with()[0] is not tuning or pull.first != start:
            raise ConfigError("the history became another while it was copied; ask again")
        pieces.append(pull.events)
        if not go():
            break
    events = Events.concat(pieces, engine.model.width)
    log = Log.resume(engine.model, base, events)
    if not (log.kind[: log.n] == READING).any():
        raise ConfigError("no reading has come yet; there is nothing to fold")
    return log, base
