"""Counters and messages about the running twin, commands of its users, and their notes at moments; all bounded."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

from estimators.errors import ConfigError, printable, quoted
from sources.tables.text import READ_AS

LINE_PERIOD_S = 1.0
"""Seconds between two lines under one key; those in between are only counted, so that a flood stays readable."""

EXPECTED = ("condition ", "repeats ", READ_AS)
"""Keys of readings that are left out as the twin's YAML has it, and of what was assumed about a format."""

MAX_LINES = 1000

MAX_ANNOTATIONS, MAX_ANNOTATION_LENGTH = 1000, 500

SPAN_MARGIN_S = 1e-3
"""By which a moment may lie outside the log: as a float64, a time of today is rounded to a quarter of a microsecond."""


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

    def report(
        self, key: str, text: str, level: str = "", *, counted: bool = True, times: int = 1, t: int | None = None
    ) -> None:
        """Count under `key`, and add a line for now or the time `t` unless one of that key came within the last second.

        The line has a level, "info", "warn" or "error", and stands for so many `times`; without a text there is none.
        By default it is a warning, or information if its readings are left out as expected.
        `counts` has the key unless it is counted better elsewhere: then `counted` is False.
        """
        with self._lock:
            self._counts[key] += times
            if not counted:
                self._elsewhere.add(key)
            when, at_count = self._last.get(key, (-LINE_PERIOD_S, 0))
            if not text or self._clock() - when < LINE_PERIOD_S:
                return
            more = self._counts[key] - at_count - times
            self._last[key] = (self._clock(), self._counts[key])
            self._number[key] = self._next
            level = level or ("info" if key.startswith(EXPECTED) else "warn")
            self._add(level, text if more < 1 else f"{text} ({more} more before)", t)

    def count(self, key: str) -> None:
        """Count under `key` without a line."""
        with self._lock:
            self._counts[key] += 1

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


MAX_COMMANDS = 1000
"""Commands of users that a running twin remembers; its store keeps more."""


@dataclass(frozen=True)
class AuditEntry:
    """A user's request that changed something: `at` in s since 1970, `path` and `body` as sent.

    `address` is that of the client, `revision` the one that was shown. `change` counts the entries and their
    replacements: those of one gesture, such as the drag of a slider, are one entry.
    """

    number: int
    at: float
    user: str
    role: str
    address: str
    path: str
    body: Mapping[str, object]
    revision: int
    change: int = 0


class Audit:
    """Audit log of a running twin; any thread may add to it and read it."""

    def __init__(self, revision: Callable[[], int]) -> None:
        self.revision = revision
        self._lock = threading.Lock()
        self._entries: deque[AuditEntry] = deque(maxlen=MAX_COMMANDS)
        self._next = self._changes = 0

    def add(self, user: Iterable[str], path: str, body: Mapping[str, object], revision: int | None = None) -> None:
        """Note a request of a user (name, role and address) that was carried out.

        `revision` was shown when it arrived, by default that of now.
        """
        with self._lock:
            name, role, address = user
            last, gesture = self._entries[-1] if self._entries else None, body.get("gesture")
            number = self._next
            if last is not None and gesture and (last.user, last.address, last.body.get("gesture")) == (
                name, address, gesture,
            ):  # fmt: skip
                number = self._entries.pop().number
            self._next, self._changes = number + 1, self._changes + 1
            revision = self.revision() if revision is None else revision
            self._entries.append(
                AuditEntry(number, time.time(), name, role, address, path, body, revision, self._changes)
            )

    def entries(self, after: int = -1) -> list[AuditEntry]:
        """Return the entries after a change, by their number; those of an earlier session have the change 0."""
        with self._lock:
            return [entry for entry in self._entries if entry.change > after]

    def restore(self, entries: Iterable[AuditEntry]) -> None:
        """Take over the entries of an earlier session."""
        with self._lock:
            self._entries.extend(replace(entry, change=0) for entry in entries)
            self._next = 1 + max((entry.number for entry in self._entries), default=-1)


@dataclass(frozen=True)
class Annotation:
    """Note of a user at a moment `t` of the log, ns."""

    number: int
    t: int
    text: str


class Annotations:
    """Notes of users, by time; changed by the engine's thread alone, read by any. They outlast a restart of the log."""

    def __init__(self) -> None:
        # Replaced, never changed, so that a reader in another thread never sees half of it.
        self.notes: tuple[Annotation, ...] = ()
        self._next = 1

    def check(self, text: str, at: float | None, number: int | None, span: tuple[int, int]) -> None:
        """Reject a note that cannot be kept; `span` has the times of the log's first and last event, ns.

        Raises:
            ConfigError: If the text is empty or too long, the moment lies outside the log, there is no note of that
                number to change, or there are too many.
        """
        length = len(_on_one_line(text))
        if not 0 < length <= MAX_ANNOTATION_LENGTH:
            raise ConfigError(
                f"Annotate: text is {quoted(text)}, of {length} characters; write 1 to {MAX_ANNOTATION_LENGTH}"
            )
        if number is not None:
            self.find(number)
        elif len(self.notes) >= MAX_ANNOTATIONS:
            raise ConfigError(f"Annotate: there are {MAX_ANNOTATIONS} notes; delete one first")
        first, last = (t * 1e-9 for t in span)
        if at is not None and not first - SPAN_MARGIN_S <= at <= last + SPAN_MARGIN_S:
            raise ConfigError(
                f"Annotate: at is {at:.12g} s; it must lie within the log, {first:.12g} to {last:.12g} s (times as in "
                "/api/episodes)"
            )

    def add_or_change(self, text: str, t: int | None, number: int | None, now: int) -> None:
        """Add a note at `t` (ns), by default `now`, or change the one of that number, which by default stays there."""
        if number is None:
            number, t = self._next, now if t is None else t
        elif t is None:
            t = self.find(number).t
        self._become([*self._without(number), Annotation(number, t, _on_one_line(text))])

    def find(self, number: int) -> Annotation:
        """Return the note of that number.

        Raises:
            ConfigError: If there is none.
        """
        for note in self.notes:
            if note.number == number:
                return note
        raise ConfigError(f"there is no note {number}; /api/annotations lists those there are")

    def delete(self, number: int) -> None:
        """Delete the note of that number, if it is still there."""
        self._become(self._without(number))

    def restore(self, notes: Iterable[Annotation]) -> None:
        """Take over the notes of an earlier session."""
        self._become([*notes])

    def _without(self, number: int) -> list[Annotation]:
        return [note for note in self.notes if note.number != number]

    def _become(self, notes: list[Annotation]) -> None:
        self._next = max([self._next, *(note.number + 1 for note in notes)])
        self.notes = tuple(sorted(notes, key=lambda note: (note.t, note.number)))


def _on_one_line(text: str) -> str:
    return " ".join(printable(text).split())
