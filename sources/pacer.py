"""Plays a recording or a simulation in its own time: speed, pause, step, seek."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from estimators.log import Events

from .source import Source, span_of

MAX_BATCH_EVENTS = 4096
"""Events returned at once at most, which bounds the work of the reader at full speed."""

MAX_TIME_NS = 2**62  # Last position of the playhead, since times are int64


class Pacer:
    """A source whose events come when the playhead reaches their time.

    `restarts` counts how often the source began again by seeking back, which invalidates earlier events.
    Speed, pause, step and seek may be called from any thread; `read` from one.
    """

    live = False

    def __init__(
        self,
        open_source: Callable[[], Source],
        *,
        speed: float = 1.0,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Open the source; the playhead starts at its first event.

        Args:
            open_source: Opens the source, at first and after each seek back.
            speed: Times real time; inf is as fast as possible.
            clock: Monotonic time, ns.

        Raises:
            SourceError: If the source cannot be opened.
        """
        self._open = open_source
        self._clock = clock
        self._changed = threading.Condition()
        self._source = open_source()
        self._pending: Events | None = None
        self._reach = np.zeros(0, np.int64)
        self._ended = False
        self._first: int | None = None
        self._last: int | None = None
        self._playhead: int | None = None
        self._anchor = clock()
        self._steps = 0
        self._seek: int | None = None
        self.speed = speed
        self.paused = False
        self.restarts = 0

    @property
    def span(self) -> tuple[int, int] | None:
        """Time of the first event and of the last one known, ns."""
        span = span_of(self._source)
        if span is not None:
            return span
        return None if self._first is None or self._last is None else (self._first, self._last)

    def now(self) -> int | None:
        """Return the playhead, ns; None before the first event and after the last.

        At high speed it runs ahead of a slower source, whose unread events may lie before it.
        """
        with self._changed:
            position = self._position()
            if position is None or (self._ended and self._pending is None):
                return None
            known = self._last if self._pending is None else int(self._reach[0])
            return position if known is None else min(position, known)

    def _position(self) -> int | None:
        if self._playhead is None or self.paused or not np.isfinite(self.speed):
            return self._playhead
        gone = (self._clock() - self._anchor) * self.speed
        return min(MAX_TIME_NS, self._playhead + round(gone)) if gone < MAX_TIME_NS else MAX_TIME_NS

    def _settle(self) -> None:
        """Make the present position the anchor, before speed or pause change."""
        self._playhead = self._position()
        self._anchor = self._clock()

    def _set(self, name: str, value: float) -> None:
        with self._changed:
            self._settle()
            setattr(self, name, value)
            self._changed.notify_all()

    def pause(self) -> None:
        """Pause the playhead."""
        self._set("paused", True)

    def resume(self) -> None:
        """Resume the playhead."""
        self._set("paused", False)

    def set_speed(self, speed: float) -> None:
        """Play `speed` times real time from here on."""
        self._set("speed", speed)

    def step(self) -> None:
        """Release the events of the next time at which there are any, and move the playhead there."""
        with self._changed:
            self._steps += 1
            self._changed.notify_all()

    def seek(self, t: int) -> None:
        """Move the playhead to t (ns): ahead, what lies between is released at once; back, the source starts again."""
        with self._changed:
            self._seek = t
            self._changed.notify_all()

    def read(self, timeout: float) -> Events | None:
        """Return the events that are due; none if none becomes due within `timeout` seconds; None at the end."""
        with self._changed:
            self._obey_seek()
            nothing = self._fill(timeout)
            if self._pending is None and self._ended:
                self._changed.wait_for(lambda: self._seek is not None, timeout)
                if self._seek is None:
                    return None
                self._obey_seek()
                nothing = self._fill(timeout)
            if self._pending is None:
                return nothing
            count = self._due()
            if count == 0:
                self._wait(timeout)
                if self._seek is None:
                    count = self._due()
            batch = self._pending.select(slice(0, count))
            rest = self._pending.select(slice(count, None))
            self._pending = rest if len(rest) else None
            self._reach = self._reach[count:]
            return batch

    def _obey_seek(self) -> None:
        if self._seek is None:
            return
        t, self._seek = self._seek, None
        position = self._position()
        if position is not None and t < position:
            self._source.close()
            self._source = self._open()
            self._pending, self._ended = None, False
            self.restarts += 1
        self._playhead, self._anchor = t, self._clock()

    def _fill(self, timeout: float) -> Events | None:
        """Read until one event waits; return an empty batch if the source has none yet, and None at its end."""
        batch: Events | None = None
        if self._pending is None and not self._ended:
            batch = self._source.read(timeout)
            if batch is None:
                self._ended = True
            elif len(batch):
                self._pending = batch
                self._reach = np.maximum.accumulate(batch.t)
                self._last = max(int(self._reach[-1]), self._last if self._last is not None else int(self._reach[-1]))
                if self._first is None:
                    self._first = int(batch.t[0])
                if self._playhead is None:
                    self._playhead, self._anchor = int(batch.t[0]), self._clock()
        return batch

    def _due(self) -> int:
        """Return how many of the waiting events the playhead has reached."""
        if self._steps:
            self._steps -= 1
            t = int(self._reach[0])
            self._playhead, self._anchor = t, self._clock()
            return int(np.searchsorted(self._reach, t, side="right"))
        if np.isinf(self.speed) and not self.paused:
            count = min(MAX_BATCH_EVENTS, self._reach.size)
            self._playhead, self._anchor = int(self._reach[count - 1]), self._clock()
            return count
        position = self._position()
        assert position is not None
        return min(MAX_BATCH_EVENTS, int(np.searchsorted(self._reach, position, side="right")))

    def _wait(self, timeout: float) -> None:
        """Wait until the next event is due, a control changes, or the timeout ends."""
        if not self.paused and np.isfinite(self.speed):
            position = self._position()
            assert position is not None
            timeout = min(timeout, max(0.0, (int(self._reach[0]) - position) / self.speed * 1e-9))
        self._changed.wait(timeout)

    def close(self) -> None:
        """Close the source."""
        with self._changed:
            self._source.close()
