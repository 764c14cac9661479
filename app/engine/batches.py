"""How folds share the engine: batches of a few milliseconds, a fair lock, and requests to fold the history again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from estimators.fold import Fold

BATCH_PERIOD_S = 0.02
"""Seconds that a batch should take; one event of a large field may take longer."""

MAX_BATCH_EVENTS = 16_384


class FairLock:
    """First-come, first-served lock: a thread that releases it and takes it again at once comes after the waiting one.

    The engine folds in batches and lets readers in between; with an ordinary lock it would have it again before they
    wake. The next thread waits at the inner lock, all others at the outer one.
    """

    def __init__(self) -> None:
        self._outer, self._lock = threading.Lock(), threading.Lock()

    def acquire(self, timeout: float = -1) -> bool:
        """Take it within so many seconds at each of the two locks; return whether that was possible."""
        if not self._outer.acquire(timeout=timeout):
            return False
        try:
            return self._lock.acquire(timeout=timeout)
        finally:
            self._outer.release()

    def release(self) -> None:
        """Release it."""
        self._lock.release()

    def __enter__(self) -> None:
        self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()


class BatchSizer:
    """Folds in batches whose size follows from the time that the last ones took. The rows do not depend on it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` returns monotonic seconds."""
        self._clock = clock
        self.begin()

    def begin(self) -> None:
        """Begin with another fold, of unknown speed."""
        self.size = 1

    def advance(self, fold: Fold) -> int:
        """Fold the next batch; return its number of events."""
        begun = self._clock()
        count = fold.advance(self.size)
        took = self._clock() - begun
        if took > BATCH_PERIOD_S:
            self.size = max(1, int(self.size * BATCH_PERIOD_S / took))
        elif took < BATCH_PERIOD_S / 8 and count == self.size:
            self.size = min(MAX_BATCH_EVENTS, 4 * self.size)
        return count


class Requests:
    """Requested refolds, and from which event on the log has changed since each request."""

    def __init__(self) -> None:
        self.newest = 0
        self._answered = 0
        self._open: dict[int, int | None] = {}

    @property
    def waiting(self) -> bool:
        """Whether the newest has no answer yet."""
        return self._answered != self.newest

    def add(self) -> int:
        """Add a request over the log as it is now; return its ticket."""
        self.newest += 1
        self._open[self.newest] = None
        return self.newest

    def changed(self, index: int) -> None:
        """The log changed from an event (its absolute index) on."""
        self._open = {ticket: index if known is None else min(known, index) for ticket, known in self._open.items()}

    def again(self, ticket: int) -> None:
        """Go on with a request over the log as it is now."""
        self._open[ticket] = None

    def state(self, ticket: int) -> tuple[bool, int | None]:
        """Return whether the log of a request is still the present one, and from where on that has changed."""
        return ticket in self._open, self._open.get(ticket)

    def answer(self, ticket: int) -> None:
        """Close this request and those before it."""
        self._answered = max(self._answered, ticket)
        self._open = {number: index for number, index in self._open.items() if number > ticket}

    def forget(self) -> None:
        """Close all requests: the log has started again, so no answer fits it."""
        self._answered = self.newest
        self._open.clear()
