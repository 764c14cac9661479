"""Counters and messages about the running twin; the messages are bounded in number."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

SECONDS_APART = 1.0
"""Between two lines under one key; those in between are counted only, so a flood of bad frames stays readable."""

KEPT = 1000


@dataclass(frozen=True)
class Notice:
    """One line for people: when (ns, the twin's time), how bad, what, in which pass over the source and revision."""

    number: int
    t: int
    level: str
    text: str
    passage: int = 0
    revision: int = 0


class Notices:
    """Counters and lines, written by any thread, read by views that remember the number of the last line they had."""

    def __init__(self, now: Callable[[], int], clock: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._elsewhere: set[str] = set()
        self._lines: deque[Notice] = deque(maxlen=KEPT)
        self._next = 0
        self.passage = 0
        """How often the source has begun again; what was said before that is of another life of the twin."""
        self.revision = 0
        """Of the estimate that is shown, as the engine counts them."""
        self._last: dict[str, tuple[float, int]] = {}

    def report(self, key: str, text: str, level: str = "warn", *, counted: bool = True, times: int = 1) -> None:
        """Count under `key`, and add a line unless one of that key came within the last second.

        Not `counted`: what is reported can be counted better elsewhere, and `counts` leaves the key out. One line may
        tell of several `times`.
        """
        with self._lock:
            self._counts[key] += times
            if not counted:
                self._elsewhere.add(key)
            when, at_count = self._last.get(key, (-SECONDS_APART, 0))
            if self._clock() - when < SECONDS_APART:
                return
            more = self._counts[key] - at_count - times
            self._last[key] = (self._clock(), self._counts[key])
            self._add(level, text if more < 1 else f"{text} ({more} more before)")

    def say(self, text: str, level: str = "info", t: int | None = None, *, passage: int | None = None) -> None:
        """Add a line, of what happened now or at `t`; nothing if that was of another `passage` than the present one."""
        with self._lock:
            if passage is None or passage == self.passage:
                self._add(level, text, t)

    def begin_again(self) -> None:
        """The source has begun again: lines from here on belong to another pass over it."""
        with self._lock:
            self.passage += 1

    def restore(self, lines: Iterable[tuple[int, str, str]]) -> None:
        """Add lines (t, level, text) of an earlier run."""
        with self._lock:
            for t, level, text in lines:
                self._add(level, text, t)

    def _add(self, level: str, text: str, t: int | None = None) -> None:
        self._lines.append(
            Notice(self._next, self._now() if t is None else t, level, text, self.passage, self.revision)
        )
        self._next += 1

    def since(self, number: int) -> list[Notice]:
        """Lines from `number` on."""
        with self._lock:
            return [line for line in self._lines if line.number >= number]

    def counts(self) -> dict[str, int]:
        """The counters."""
        with self._lock:
            return {key: count for key, count in self._counts.items() if key not in self._elsewhere}
