"""IdleTicks: when nothing arrives, the estimate is asked what it is now, so that its growing uncertainty shows."""

from __future__ import annotations

import time

import numpy as np

from sources.source import Paced, Source


class IdleTicks:
    """How long the source has said nothing, and when to ask."""

    def __init__(self, tick: float) -> None:
        """`tick`: seconds of silence after which to ask first."""
        self._tick = tick
        self._since = time.monotonic()
        self._newest: int | None = None

    def broken(self, newest: int) -> None:
        """Something arrived; `newest` is the time of the log's newest event, ns."""
        self._since = time.monotonic()
        self._newest = newest

    def asks(self, source: Source, last: int) -> int | None:
        """The time (ns) for which to ask now, after the log's last event at `last`; None for not yet."""
        silent = time.monotonic() - self._since
        if silent < self._tick:
            return None
        if source.live:
            assert self._newest is not None
            # Counted from the newest reading: a driver's clock need not be this machine's.
            now: int | None = self._newest + int(silent * 1e9)
        elif isinstance(source, Paced) and (source.paused or source.speed == np.inf):
            # As fast as possible, the playhead is ahead of what has been read.
            now = None
        else:
            now = source.now()
        # The longer the silence, the rarer the question: a night of it must not fill the log.
        apart = max(self._tick, silent / 20)
        return None if now is None or now <= last + apart * 0.9e9 else now
