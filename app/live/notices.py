"""Counters and messages about the running twin; the number of messages is bounded."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

LINE_PERIOD_S = 1.0
"""Seconds between two lines under one key; those in between are only counted, so that a flood stays readable."""

MAX_LINES = 1000


@dataclass(frozen=True)
class Notice:
    """One line for users: time (ns, the twin's), level, text, pass over the source, and revision."""

    number: int
    t: int
    level: str
    text: str
    passage: int = 0
    revision: int = 0


class Notices:
    """Counters and lines, written by any thread; readers remember the number of their last line."""

    def __init__(self, now: Callable[[], int], clock: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._elsewhere: set[str] = set()
        self._lines: deque[Notice] = deque(maxlen=MAX_LINES)
        self._next = 0
        self.passage = 0
        """How often the source has begun again; earlier lines belong to another pass."""
        self.revision = 0
        """Number of the revision that is shown."""
        self._last: dict[str, tuple[float, int]] = {}
        self._number: dict[str, int] = {}

    def report(self, key: str, text: str, level: str = "warn", *, counted: bool = True, times: int = 1) -> None:
        """Count under `key`, and add a line unless one of that key came within the last second.

        Args:
            key: Of the counter.
            text: Of the line.
            level: Of the line: "info", "warn" or "error".
            counted: Whether `counts` has the key; False if it is counted better elsewhere.
            times: How many the line stands for.
        """
        with self._lock:
            self._counts[key] += times
            if not counted:
                self._elsewhere.add(key)
            when, at_count = self._last.get(key, (-LINE_PERIOD_S, 0))
            if self._clock() - when < LINE_PERIOD_S:
                return
            more = self._counts[key] - at_count - times
            self._last[key] = (self._clock(), self._counts[key])
            self._number[key] = self._next
            self._add(level, text if more < 1 else f"{text} ({more} more before)")

    def latest(self, key: str, seconds: float) -> str | None:
        """Return the last line under a key that was reported within some seconds; None if there is none."""
        with self._lock:
            when, number = self._last.get(key, (-math.inf, 0))[0], self._number.get(key, -1)
            if self._clock() - when > seconds:
                return None
            return next((line.text for line in reversed(self._lines) if line.number == number), None)

    def say(self, text: str, level: str = "info", t: int | None = None, *, passage: int | None = None) -> None:
        """Add a line for now or the time `t`, unless it belongs to another `passage` than the present one."""
        with self._lock:
            if passage is None or passage == self.passage:
                self._add(level, text, t)

    def begin_again(self) -> None:
        """Begin another pass: the source has begun again."""
        with self._lock:
            self.passage += 1

    def restore(self, lines: Iterable[tuple[int, str, str]]) -> None:
        """Add lines (t, level, text) of an earlier session."""
        with self._lock:
            for t, level, text in lines:
                self._add(level, text, t)

    def _add(self, level: str, text: str, t: int | None = None) -> None:
        self._lines.append(
            Notice(self._next, self._now() if t is None else t, level, text, self.passage, self.revision)
        )
        self._next += 1

    def since(self, number: int) -> list[Notice]:
        """Return the lines from `number` on."""
        with self._lock:
            return [line for line in self._lines if line.number >= number]

    def counts(self) -> dict[str, int]:
        """Return the counters."""
        with self._lock:
            return {key: count for key, count in self._counts.items() if key not in self._elsewhere}
