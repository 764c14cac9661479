"""Between a browser's edits and the engine: of many values for one key only the latest, and not too often."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from ...live.commands import Command

DRAG_INTERVAL = 0.08
"""Seconds between two values of one key while a slider is dragged."""

TYPING_PAUSE = 0.6
"""Seconds without a keystroke after which a typed value counts: 0.05 passes through 0 on its way."""


class Coalescer:
    """Passes commands on, at most one a key an interval; a held-back one goes out with a later `flush`."""

    def __init__(self, submit: Callable[[Command], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._submit = submit
        self._clock = clock
        self._lock = threading.Lock()
        self._sent: dict[str, float] = {}
        self._held: dict[str, tuple[float, Command]] = {}

    def dragged(self, key: str, command: Command) -> None:
        """A value of a stream of values: sent now, or held back until the interval is over."""
        with self._lock:
            now = self._clock()
            due = self._sent.get(key, -DRAG_INTERVAL) + DRAG_INTERVAL
            if now < due:
                self._held[key] = (due, command)
                return
            self._held.pop(key, None)
            self._sent[key] = now
            self._submit(command)

    def typed(self, key: str, command: Command) -> None:
        """A value that may be half typed: sent after a pause, unless another follows."""
        with self._lock:
            self._held[key] = (self._clock() + TYPING_PAUSE, command)

    def forget(self, key: str) -> None:
        """Drop what is held back under a key."""
        with self._lock:
            self._held.pop(key, None)

    def flush(self) -> None:
        """Send what is due."""
        with self._lock:
            now = self._clock()
            for key in [key for key, (due, _) in self._held.items() if due <= now]:
                _, command = self._held.pop(key)
                self._sent[key] = now
                self._submit(command)

    def waiting(self, key: str) -> bool:
        """Whether a value is held back under a key."""
        with self._lock:
            return key in self._held
