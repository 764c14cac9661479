"""Faults of time: delays, bursts, repetitions, and clocks that are wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

import numpy as np

from .effect import Moment
from .item import Item
from .target import Target


def ns(seconds: float) -> int:
    """Whole nanoseconds."""
    return round(seconds * 1e9)


@dataclass(frozen=True)
class Sent:
    """What is known when an event is sent: ns since the fault began at its arrival, seconds at its measurement, draws.

    `draw` is one of the standard exponential distribution.
    """

    since: int
    seconds: float
    hit: bool
    draw: float
    size: float
    every: float
    count: int


Shifts = list[tuple[int, int]]
"""For each event that comes in place of one: ns added to its stamp, and to its arrival."""


def _bursts(sent: Sent) -> Shifts:
    every = ns(sent.every)
    return [(0, max(1, ceil(sent.since / every)) * every - sent.since)]


def _duplicate(sent: Sent) -> Shifts:
    count = sent.count if sent.hit else 0
    return [(ns(k * sent.every), ns(k * sent.every)) for k in range(count + 1)]


SHIFT: dict[str, Callable[[Sent], Shifts]] = {
    "delay": lambda sent: [(0, ns(sent.size))],
    "jitter": lambda sent: [(0, ns(sent.size * sent.draw))],
    "bursts": _bursts,
    "duplicate": _duplicate,
    "clock_jump": lambda sent: [(ns(sent.size), 0)],
    "clock_drift": lambda sent: [(ns(sent.size * sent.seconds), 0)],
}
"""What a kind does to the times of an event."""


class TimeEffect:
    """Shifts the times of its target's events. One that arrives later is given out when its time has come."""

    def __init__(self, kind: str, target: Target, numbers: dict[str, float], rng: np.random.Generator) -> None:
        self._shift = SHIFT[kind]
        self._target, self._rng = target, rng
        self._size, self._rate = numbers.get("size", 0.0), numbers.get("rate", 1.0)
        self._every, self._count = numbers.get("every", 0.0), round(numbers.get("count", 1.0))
        self.lost = 0

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """The event with its times shifted, and its repetitions."""
        hit, draw = False, 0.0
        if moment.draws:
            hit = bool(self._rng.random() < self._rate)
            draw = float(self._rng.standard_exponential())
        if not moment.during:
            return [item]
        rest, mine = self._target.apart(item)
        # A late event arrives later than it was measured.
        since = moment.since + mine.arrival - mine.at
        shifts = self._shift(Sent(since, moment.seconds, hit, draw, self._size, self._every, self._count))
        return [*rest, *(mine.but(t=mine.t + stamp, arrival=mine.arrival + late) for stamp, late in shifts)]

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """Nothing is said of it."""
        return []

    def flush(self) -> list[Item]:
        """It keeps nothing back; what arrives later waits outside."""
        return []


class Reorder:
    """Keeps an event back until the next one of its kind and channel has come, and lets it arrive after that."""

    def __init__(self, kind: str, target: Target, numbers: dict[str, float], rng: np.random.Generator) -> None:
        self._target, self._rng, self._rate = target, rng, numbers["rate"]
        self._kept: dict[tuple[int, int], Item] = {}
        self.lost = 0

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """Nothing, the event, or the event and the one before it."""
        hit = moment.draws and bool(self._rng.random() < self._rate)
        rest, mine = self._target.apart(item)
        key = (mine.kind, mine.channel)
        before = self._kept.pop(key, None)
        if before is not None:
            return [*rest, mine, before.but(arrival=max(before.arrival, mine.arrival))]
        if hit and moment.during:
            self._kept[key] = mine
            return rest
        return [item]

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """Nothing is said of it."""
        return []

    def flush(self) -> list[Item]:
        """What waits for a next one that does not come."""
        kept, self._kept = list(self._kept.values()), {}
        return kept
