"""What the guard of times works on, and what it says: events that wait, events that pass, clocks that were set."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .batch import Events


class Refused(NamedTuple):
    """A lone event whose time was far ahead: its kind, channel, time (ns) and where its clock was expected (ns)."""

    kind: int
    channel: int
    t: int
    expected: int


class Moved(NamedTuple):
    """A clock that was set: kind and channel of its first event, its time as stamped, and by how much it moved (ns)."""

    kind: int
    channel: int
    t: int
    by: int


class Passed(NamedTuple):
    """What may go to the log, in order. `settled` (N,) were held: they came in time, so no horizon applies to them."""

    events: Events
    settled: np.ndarray
    refused: list[Refused]
    moved: list[Moved]


def plain_events(batch: Events) -> Events:
    """The batch, its columns as the compiled functions read them; as it is, where it is so."""
    types_ = (np.int64, np.int64, np.int8, np.int32)
    columns = [np.ascontiguousarray(column, kind) for column, kind in zip(batch[:4], types_, strict=True)]
    if all(a is b for a, b in zip(columns, batch, strict=False)):
        return batch
    return Events(columns[0], columns[1], columns[2], columns[3], batch.value)


class Run:
    """Events of one channel that agree on another time, held until it is told whether that is true.

    `ahead` or back; `live` where arrivals are known. `begin` is the newest time of all that was said before. `agree` is
    how far apart t - arrival may be of those that count as on time. `top` is the largest t - arrival, `begun` the
    first arrival, `arrived` the last of those on time, `highest` the largest time. All in ns.
    """

    def __init__(self, ahead: bool, live: bool, begin: int, agree: int, most: int) -> None:
        self.ahead, self.live, self.begin = ahead, live, begin
        self._agree, self._most = agree, most
        self.at: list[int] = []
        self.t: list[int] = []
        self.top = self.begun = self.arrived = self.highest = self._lowest = 0
        self._on_time: deque[tuple[int, int, int]] = deque()

    @property
    def full(self) -> bool:
        """Whether it never settled."""
        return len(self.at) >= self._most

    @property
    def span(self) -> int:
        """For how long they agree, by their own time; where arrivals are known by those too, of the ones on time.

        A block that was held up and comes in one go has no span.
        """
        if not self.live:
            return self.highest - self._lowest
        (_, t, arrival), (_, newest, arrived) = self._on_time[0], self._on_time[-1]
        return min(newest - t, arrived - arrival)

    def add(self, i: int, t: int, arrival: int) -> None:
        """The next of them: its place in the work, its time and its arrival."""
        offset = t - arrival
        first = not self.at
        self.begun = arrival if first else self.begun
        self.top = offset if first else max(offset, self.top)
        self.highest, self._lowest = (t, t) if first else (max(t, self.highest), min(t, self._lowest))
        self.at.append(i)
        self.t.append(t)
        if offset >= self.top - self._agree:
            self._on_time.append((offset, t, arrival))
            self.arrived = arrival
        while self._on_time[0][0] < self.top - self._agree:
            self._on_time.popleft()


class Work:
    """Events that were held and a batch, one after the other, and what becomes of them."""

    def __init__(self, events: Events, rows: np.ndarray, raw: np.ndarray, begin: int) -> None:
        """The rows of the state (n,), the times as stamped, and how many of the events were held."""
        self._events = events
        self.t, self.arrival, self.kind, self.channel = events[:4]
        self.rows, self.raw, self.begin = rows, raw, begin
        self.live = self.raw != self.arrival
        self.order: list[int] = []
        self.settled: list[bool] = []
        self.refused: list[Refused] = []
        self.moved: list[Moved] = []

    def emit(self, at: Sequence[int], *, settled: bool = False) -> None:
        """These pass, in this order."""
        self.order.extend(at)
        self.settled.extend([settled] * len(at))

    def shift(self, row: int, held: list[int], step: int) -> None:
        """The clock of a row was set: correct what is held, and what is still to come."""
        later = np.flatnonzero(self.rows == row)
        self.t[held] += step
        self.t[later[later > held[-1]]] += step

    def select(self, at: list[int]) -> Events:
        """The events at these places."""
        return self._events.select(np.array(at, np.int64))
