"""Folds the whole history again beside the running twin, with another estimator or tuning."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from estimators.errors import NisusError
from estimators.fold import Fold

from .watchdog import Watchdog

BATCH_PERIOD_S = 0.02
"""Seconds that a batch should take; one event of a large field may take longer."""

MAX_BATCH_EVENTS = 16_384

REFOLD_REMEDY = "the running estimate goes on. Correct the model, or choose another tuning"
"""End of the line about a refold that does not return."""


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

    def __exit__(self, *_: Any) -> None:
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


@dataclass(frozen=True)
class Refolded:
    """A finished fold over a copy of the log, or the reason why there is none; `ticket` is that of the request."""

    ticket: int
    fold: Fold | None
    error: str


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

    def ask(self) -> int:
        """Add a request over the log as it is now; return its ticket."""
        self.newest += 1
        self._open[self.newest] = None
        return self.newest

    def changed(self, index: int) -> None:
        """The log changed from an event (its absolute index) on."""
        self._open = {ticket: index if known is None else min(known, index) for ticket, known in self._open.items()}

    def look(self, ticket: int) -> tuple[bool, int | None]:
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


class Refolder:
    """One thread and one fold at a time; of the requests that arrive meanwhile only the latest counts."""

    def __init__(self, done: Callable[[Refolded], None]) -> None:
        self._done = done
        self._wake = threading.Condition()
        self._pending: tuple[int, Callable[[], Fold]] | None = None
        self._stopping = False
        self._ticket = 0
        # A long history may take minutes: only a function that does not return ends a refold.
        self._watchdog = Watchdog(self._give_up, then=REFOLD_REMEDY, long=math.inf)
        self._thread = threading.Thread(target=self._run, name="refold", daemon=True)

    def start(self) -> None:
        """Wait for requests."""
        self._thread.start()
        self._watchdog.start()

    def stop(self) -> None:
        """Give up the fold that is under way."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)
        self._watchdog.stop()

    def request(self, ticket: int, make: Callable[[], Fold]) -> None:
        """Fold what `make` prepares (in the thread: it may have to compile) as soon as the present one is done."""
        with self._wake:
            self._pending = (ticket, make)
            self._wake.notify()

    def step(self) -> bool:
        """Carry out the waiting request in this thread; return whether there was one."""
        with self._wake:
            pending, self._pending = self._pending, None
        if pending is not None:
            self._done(self._fold(*pending))
        return pending is not None

    def _give_up(self, text: str, level: str) -> None:
        """Leave the thread in a function that does not return, and go on with another."""
        if level != "error":
            return
        with self._wake:
            self._thread = threading.Thread(target=self._run, name="refold", daemon=True)
            self._thread.start()
        self._done(Refolded(self._ticket, None, text))

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._pending is not None or self._stopping)
                if self._stopping or self._pending is None:
                    return
                (self._ticket, make), self._pending = self._pending, None
                ticket = self._ticket
            answer = self._fold(ticket, make)
            with self._wake:
                if threading.current_thread() is not self._thread:
                    return
            self._done(answer)

    def _fold(self, ticket: int, make: Callable[[], Fold]) -> Refolded:
        try:
            fold, batches = make(), BatchSizer()
            with self._watchdog.watched(fold):
                while batches.advance(fold) and not self._stopping:
                    pass
        except NisusError as error:
            return Refolded(ticket, None, str(error))
        except (Exception, SystemExit) as error:  # noqa: BLE001  a user's model may raise anything; the twin goes on
            return Refolded(ticket, None, f"{type(error).__name__}: {error}")
        return Refolded(ticket, fold, "")
