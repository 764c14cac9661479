"""Plays a recording or a simulation in its own time, or slower, faster, step by step."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

import numpy as np

from estimators.errors import SourceError
from estimators.log import Readings

from .source import Source

MOST_EVENTS = 4096
"""Events released at once, so that who reads them can breathe."""

_NEVER = np.iinfo(np.int64).max


class Pacer:
    """Releases the events of a source when playback time reaches them.

    Playback time is the time in the recording. It starts at the first event and runs `speed` times as fast as the
    clock. Any thread may give commands; one thread reads. Events keep the order in which the source gives them: one
    that was measured earlier than the event before it is released together with that one.

    `live` is False although it keeps time: who reads it may let it wait, and what is due meanwhile comes later.

    Args:
        open_source: Opens the source; called again to start from the beginning, for a seek backwards.
        speed: Times real time; inf is as fast as possible.
        clock: Monotonic time, ns; for tests.

    Raises:
        SourceError: If the source cannot be opened, or is a live one.
    """

    live = False

    def __init__(
        self,
        open_source: Callable[[], Source],
        *,
        speed: float = 1.0,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._open = open_source
        self._clock = clock
        self._source = open_source()
        if self._source.live:
            self._source.close()
            raise SourceError("a live source sets its own pace; only a recording or a simulation can be paced")
        self._wake = threading.Condition()
        self._pending: Readings | None = None
        self._due = np.zeros(0, np.int64)
        self._width = 1
        self._latest = -_NEVER
        self._ended = False
        self._closed = False
        self._speed = _checked(speed)
        self._paused = False
        self._steps = 0
        # Playback time was `_at` when the clock showed `_since`; None before the first event.
        self._at: int | None = None
        self._since = clock()
        self._released: int | None = None
        self._back_to: int | None = None
        self.restarts = 0
        """How often the source was started again from its beginning; the events after it are those from the start."""

    @property
    def speed(self) -> float:
        """Times real time."""
        return self._speed

    @property
    def paused(self) -> bool:
        """Whether playback time stands still."""
        return self._paused

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time, ns; None if the source does not tell."""
        return getattr(self._source, "span", None)

    @property
    def endless(self) -> bool:
        """Whether the source has no end."""
        return getattr(self._source, "endless", False)

    def now(self) -> int | None:
        """Playback time, ns; None before the first event. It does not run past the last event."""
        with self._wake:
            return self._now()

    def _now(self) -> int | None:
        if self._at is None or self._back_to is not None:
            return self._back_to
        if self._speed == math.inf and not self._paused:
            return max(self._at, self._released) if self._released is not None else self._at
        return min(self._position(), self._latest) if self._ended and not self._due.size else self._position()

    def _position(self) -> int:
        """Up to where events are due."""
        assert self._at is not None
        if self._paused:
            return self._at
        if self._speed == math.inf:
            return _NEVER
        return self._at + round((self._clock() - self._since) * self._speed)

    def _anchor(self) -> None:
        """Playback time goes on from here, under what holds from now on."""
        now = self._now()
        if now is not None and self._back_to is None:
            self._at = now
        self._since = self._clock()

    def pause(self) -> None:
        """Let playback time stand still."""
        with self._wake:
            self._anchor()
            self._paused = True
            self._wake.notify_all()

    def resume(self) -> None:
        """Let it run on."""
        with self._wake:
            self._anchor()
            self._paused = False
            self._steps = 0
            self._wake.notify_all()

    def set_speed(self, speed: float) -> None:
        """Times real time from now on; inf is as fast as possible.

        Raises:
            SourceError: If it is not positive.
        """
        with self._wake:
            speed = _checked(speed)
            self._anchor()
            self._speed = speed
            self._wake.notify_all()

    def step(self) -> None:
        """Release the events of the next timestamp, and stay paused."""
        with self._wake:
            self._anchor()
            self._paused = True
            self._steps += 1
            self._wake.notify_all()

    def seek(self, t: int) -> None:
        """Go to time `t`, ns: all events up to it come at once; backwards, the source starts again for that."""
        with self._wake:
            now = self._now()
            if now is not None and t < now:
                self._back_to = t
            else:
                self._at = t
            self._steps = 0
            self._since = self._clock()
            self._wake.notify_all()

    def read(self, timeout: float) -> Readings | None:
        """The events that are due; waits up to `timeout` seconds for the first. None after the last."""
        batch = self._take()
        if batch is None or len(batch):
            return batch
        with self._wake:
            wait = min(timeout, self._until_due())
            # A command may have come since `_take` looked; then there is nothing to wait for.
            if wait > 0 and not self._closed and self._back_to is None and not self._steps:
                self._wake.wait(wait)
        return self._take()

    def _until_due(self) -> float:
        """Seconds until the next event is due."""
        if self._paused or self._at is None or not self._due.size:
            return math.inf
        return max(0.0, (int(self._due[0]) - self._position()) / self._speed * 1e-9)

    def _take(self) -> Readings | None:
        """What is due now, without waiting. Only the reading thread touches source and pending events."""
        self._restart_if_asked()
        if self._closed:
            return None
        self._fill()
        with self._wake:
            if self._back_to is not None:
                return self._none()
            if not self._due.size:
                return None if self._ended else self._none()
            if self._released is None:
                # Nothing happens before the first event, so that time is not waited for.
                first = int(self._due[0])
                if self._at is None or (self._at < first and not self._paused):
                    self._at, self._since = first, self._clock()
            limit = self._position()
            stepping = self._steps > 0 and self._paused
            if stepping:
                limit = self._at = max(int(self._due[0]), self._at)
            count = min(int(np.searchsorted(self._due, limit, side="right")), MOST_EVENTS)
            if stepping and count == self._due.size and not self._ended:
                # More of the same timestamp may follow in the source's next batch.
                self._fill_more()
                count = min(int(np.searchsorted(self._due, limit, side="right")), MOST_EVENTS)
            if stepping and count < MOST_EVENTS:
                self._steps -= 1
            if not count:
                return self._none()
            assert self._pending is not None
            batch = self._pending.select(slice(0, count))
            self._released = int(self._due[count - 1])
            self._pending, self._due = self._pending.select(slice(count, None)), self._due[count:]
        return batch._replace(arrival=np.full(count, time.time_ns(), np.int64))

    def _none(self) -> Readings:
        return Readings.empty(self._width)

    def _fill(self) -> None:
        """Have something pending, unless the source ended. Reads without the lock: a file may take a while."""
        while not self._due.size and not self._ended:
            batch = self._source.read(0.0)
            if batch is None:
                self._ended = True
            elif len(batch):
                self._append(batch)

    def _fill_more(self) -> None:
        while not self._ended:
            batch = self._source.read(0.0)
            if batch is None:
                self._ended = True
            elif len(batch):
                first = int(self._due[0])
                self._append(batch)
                if self._latest > first:
                    return

    def _append(self, batch: Readings) -> None:
        due = np.maximum(np.maximum.accumulate(batch.t), self._latest)
        self._latest = int(due[-1])
        if self._due.size:
            assert self._pending is not None
            batch = Readings.concat([self._pending, batch], batch.value.shape[1])
            due = np.concatenate((self._due, due))
        self._pending, self._due, self._width = batch, due, batch.value.shape[1]

    def _restart_if_asked(self) -> None:
        with self._wake:
            if self._back_to is None or self._closed:
                return
            back_to = self._back_to
        self._source.close()
        source = self._open()
        with self._wake:
            self._source = source
            self._pending, self._due = None, np.zeros(0, np.int64)
            self._latest, self._ended, self._released = -_NEVER, False, None
            # A second command may have come while the source opened; the last one counts.
            self._at = back_to if self._back_to is None else self._back_to
            self._back_to = None
            self._since = self._clock()
            self.restarts += 1

    def close(self) -> None:
        """Stop playing."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        self._source.close()


def _checked(speed: float) -> float:
    if not speed > 0:
        raise SourceError(f"speed is {speed}; it must be positive, or inf for as fast as possible")
    return float(speed)
