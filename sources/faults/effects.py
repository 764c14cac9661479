"""Faults of the way that events take: what never arrives, and what comes under another name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from estimators.log import INPUT

from .effect import Item, Moment, Target


class Silence:
    """Swallows the events of its target; of an input it only forgets to tell it."""

    def __init__(self, kind: str, target: Target, numbers: dict[str, float], rng: np.random.Generator) -> None:
        self._target = target
        self._last: float | None = None
        self.lost = 0

    def told(self, value: float) -> None:
        """What the target, an input, is when the fault is made."""
        self._last = value

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """What the event tells of anything else."""
        if self._target.input is not None:
            self._last = float(item.value[self._target.input])
        if not moment.during:
            return [item]
        self.lost += 1
        return self._target.apart(item)[0]

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """At its end an input is told again, as it may not change for long."""
        if moment.during or self._target.input is None or self._last is None:
            return []
        value = np.full_like(item.value, np.nan)
        value[self._target.input] = self._last
        return [Item(item.at, item.arrival, INPUT, 0, value, item.at)]

    def flush(self) -> list[Item]:
        """What it swallowed is lost."""
        return []


class Swap:
    """Gives the readings of each of two sensors as the other's."""

    def __init__(self, first: int, second: int) -> None:
        self._other = {first: second, second: first}
        self.lost = 0

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """The reading under the other's name."""
        return [item.but(channel=self._other[item.channel])] if moment.during else [item]

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """Nothing is said of it."""
        return []

    def flush(self) -> list[Item]:
        """It keeps nothing back."""
        return []


class Elsewhere:
    """What acts where the events are made, and not on them: a change of the asset."""

    lost = 0

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """The event as it is."""
        return [item]

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """Nothing is said of it."""
        return []

    def flush(self) -> list[Item]:
        """It keeps nothing back."""
        return []


@dataclass(frozen=True)
class Said:
    """What is known when a value is spoiled: y (ny,), what was said last, seconds, a hit, draws of N(0, 1) (ny,)."""

    y: np.ndarray
    held: np.ndarray
    seconds: float
    hit: bool
    draw: np.ndarray
    size: float


SPOIL: dict[str, Callable[[Said], np.ndarray]] = {
    "bias": lambda said: said.y + said.size,
    "drift": lambda said: said.y + said.size * said.seconds,
    "scale": lambda said: said.y * said.size,
    # What is lost stays lost.
    "stuck": lambda said: np.where(np.isnan(said.y), said.y, said.held),
    "spike": lambda said: said.y + said.size * said.draw if said.hit else said.y,
    "noise": lambda said: said.y + said.size * said.draw,
    "quantisation": lambda said: np.round(said.y / said.size) * said.size,
    "dropout": lambda said: np.full(said.y.size, np.nan) if said.hit else said.y,
}
"""What a kind makes of y."""


class ValueEffect:
    """Spoils the values of its target.

    For every event of the target it draws a number and then one for each row, whatever the kind: so the draws of a
    scheduled fault do not depend on its ends, and a fault on one row leaves those of the others.
    """

    def __init__(self, kind: str, target: Target, numbers: dict[str, float], rng: np.random.Generator) -> None:
        self._spoil = SPOIL[kind]
        self._target, self._rng = target, rng
        self._size, self._rate = numbers.get("size", 0.0), numbers.get("rate", 1.0)
        self._held: dict[tuple[int, int], np.ndarray] = {}
        self._last: np.ndarray | None = None
        self.lost = 0

    def told(self, value: float) -> None:
        """What the target, an input, is when the fault is made."""
        self._last = np.array([value])

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """The event with its values spoiled."""
        cells = self._target.cells(item)
        y = item.value[cells]
        if item.kind == INPUT:
            self._last = y
        return [item.with_cells(cells, self._spoiled(y, item, moment))]

    def _spoiled(self, y: np.ndarray, item: Item, moment: Moment) -> np.ndarray:
        hit, draw = False, np.zeros(y.size)
        if moment.draws:
            hit = bool(self._rng.random() < self._rate)
            draw = self._rng.standard_normal(y.size)
        key = (item.kind, item.channel)
        held = self._held.get(key)
        if not moment.during or held is None:
            self._held[key] = held = y if held is None else np.where(np.isnan(y), held, y)
        if not moment.during:
            return y
        spoiled = self._spoil(Said(y, held, moment.seconds, hit, draw, self._size))
        return np.where(self._target.touched(y.size), spoiled, y)

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """An input is told anew: it holds until it changes, and may not be told again for long."""
        if self._target.input is None or self._last is None:
            return []
        value = np.full_like(item.value, np.nan)
        cells = slice(self._target.input, self._target.input + 1)
        told = Item(item.at, item.arrival, INPUT, 0, value, item.at)
        if not moment.during:
            return [told.with_cells(cells, self._last)]
        quiet = replace(moment, draws=False)
        return [told.with_cells(cells, self._spoiled(self._last, told, quiet))]

    def flush(self) -> list[Item]:
        """It keeps nothing back."""
        return []


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
