"""The thread that reads the source, so that the engine never waits for it; a live source that fails is reopened."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from estimators.errors import reason_of
from sources.source import controls_of

from .jobs import LoopThread

if TYPE_CHECKING:
    from estimators.log import Events
    from sources.source import Source

READ_TIMEOUT_S = 0.05

MAX_RETRY_S = 5.0
"""Seconds between two attempts to reopen a source, at most."""

MAX_BATCHES_AHEAD = 32
"""Batches that may wait for the engine. A replay waits then; a bus is never held up."""


class SourceBatch(NamedTuple):
    """Events of a source, and its `mark` after them; 0 of a source that does not count what it has read."""

    events: Events
    mark: int


class Feeder:
    """Reads a source into the engine's inbox until it ends or `stop` is called."""

    def __init__(
        self,
        open_source: Callable[[], Source],
        inbox: queue.SimpleQueue[SourceBatch | Callable[[], object]],
        report: Callable[[str, str], None],
        *,
        restarted: Callable[[], None] = lambda: None,
        finished: Callable[[], None] = lambda: None,
    ) -> None:
        """Open the source at once, so that the caller gets its error.

        Args:
            open_source: Opens the source.
            inbox: Takes its batches.
            report: Called with key and text of a failure.
            restarted: Put into the inbox before the first batch of a source that began again.
            finished: Put into the inbox after the last batch.

        Raises:
            SourceError: If the source cannot be opened.
        """
        self._open, self._inbox, self._report = open_source, inbox, report
        self._restarted, self._finished = restarted, finished
        self.source = open_source()
        self.live = self.source.live
        self.waits = not self.live or getattr(self.innermost, "waits", False)
        """Whether the source waits for the engine, as files do and a bus does not."""
        self._mark = 0
        self._room = threading.Semaphore(MAX_BATCHES_AHEAD)
        self._thread = LoopThread(self._run, "source")

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def stop(self) -> None:
        """Stop reading and close the source."""
        self._thread.stop(2.0, self._room.release)
        try:
            self.source.close()
        except Exception as error:  # noqa: BLE001  as in `_run`; the rest of the twin ends too
            self._report("source not closed", f"source cannot be closed: {reason_of(error)}")

    def taken(self) -> None:
        """Make room for one batch more."""
        self._room.release()

    def read(self, timeout: float) -> int | None:
        """Pass one batch on and return its number of events; None at the end of the source."""
        before = self._restarts()
        batch = self.source.read(timeout)
        if self._restarts() != before:
            self._inbox.put(self._restarted)
        if batch is None:
            return None
        mark = getattr(self.innermost, "mark", 0)
        if len(batch) or mark != self._mark:
            if self.waits:
                self._room.acquire()
            self._inbox.put(SourceBatch(batch, mark))
        self._mark = mark
        return len(batch)

    @property
    def innermost(self) -> Source:
        """The source itself, also if faults are injected into it."""
        return getattr(self.source, "inner", self.source)

    def _restarts(self) -> int:
        paced = controls_of(self.source)
        return paced.restarts if paced is not None else 0

    def _run(self) -> None:
        wait, ended = 0.1, False
        while not self._thread.stopping.is_set():
            try:
                if self.read(READ_TIMEOUT_S) is not None:
                    ended = False
                elif controls_of(self.source) is None:
                    self._inbox.put(self._finished)
                    return
                elif not ended:
                    # A replay can still be sought back, so it is read again.
                    ended = True
                    self._inbox.put(self._finished)
                wait = 0.1
            except Exception as error:  # noqa: BLE001  whatever a driver raises, the twin goes on
                text = reason_of(error)
                self._report("source failed", f"source failed: {text}")
                if not self.live:
                    self._inbox.put(self._finished)
                    return
                if self._thread.stopping.wait(wait):
                    return
                wait = min(MAX_RETRY_S, 2 * wait)
                self._reopen()

    def _reopen(self) -> None:
        try:
            self.source.close()
            self.source = self._open()
            self._report("source reopened", "source reopened")
        except Exception as error:  # noqa: BLE001  as above; the next round tries again
            self._report("source failed", f"source cannot be reopened: {error}")
