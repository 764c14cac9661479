"""The thread that reads the source, so that the engine never waits for one; a live source that fails is reopened."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from estimators.errors import NisusError
from sources.source import Paced

if TYPE_CHECKING:
    from sources.source import Source

READ_TIMEOUT = 0.05
AHEAD = 32
"""Batches that may wait for the engine; a source that can be asked later then waits, a bus is never held up."""


class Restarted:
    """In the queue before the first batch of a source that was started again from its beginning."""


class Finished:
    """In the queue after the last batch."""


class Feeder:
    """Reads a source into the engine's inbox until it ends or `stop` is called."""

    def __init__(
        self,
        open_source: Callable[[], Source],
        inbox: queue.SimpleQueue[Any],
        report: Callable[[str, str], None],
    ) -> None:
        """Open the source at once, so that an error reaches who starts the twin.

        Raises:
            SourceError: If the source cannot be opened.
        """
        self._open = open_source
        self._inbox = inbox
        self._report = report
        self._take(open_source())
        self.live = self.source.live
        self._stop = threading.Event()
        self._room = threading.Semaphore(AHEAD)
        self._thread = threading.Thread(target=self._run, name="source", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def stop(self) -> None:
        """Stop reading and close the source."""
        self._stop.set()
        self._room.release()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)
        self.source.close()

    def taken(self) -> None:
        """The engine took one batch."""
        self._room.release()

    def _run(self) -> None:
        wait = 0.1
        ended = False
        while not self._stop.is_set():
            try:
                if self.read(READ_TIMEOUT) is not None:
                    ended = False
                elif self._paced is None:
                    self._inbox.put(Finished())
                    return
                elif not ended:
                    # A replay can still be sought back, so it is asked again.
                    ended = True
                    self._inbox.put(Finished())
                wait = 0.1
            except Exception as error:  # noqa: BLE001  whatever a driver raises, the twin goes on
                if not isinstance(error, NisusError):
                    error = NisusError(f"{type(error).__name__}: {error}")
                self._report("source failed", f"source failed: {error}")
                if not self.live:
                    self._inbox.put(Finished())
                    return
                if self._stop.wait(wait):
                    return
                wait = min(5.0, 2 * wait)
                self._reopen()

    def _reopen(self) -> None:
        try:
            self.source.close()
            self._take(self._open())
            self._report("source reopened", "source reopened")
        except Exception as error:  # noqa: BLE001  as above; the next round tries again
            self._report("source failed", f"source cannot be reopened: {error}")

    def _take(self, source: Source) -> None:
        self.source = source
        self._paced = source if isinstance(source, Paced) else None

    def _restarts(self) -> int:
        return self._paced.restarts if self._paced is not None else 0

    def read(self, timeout: float) -> int | None:
        """Pass one batch on and return its number of events; None at the end of the source."""
        before = self._restarts()
        batch = self.source.read(timeout)
        if self._restarts() != before:
            self._inbox.put(Restarted())
        if batch is None:
            return None
        if len(batch):
            if not self.source.live:
                self._room.acquire()
            self._inbox.put(batch)
        return len(batch)
