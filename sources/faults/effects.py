"""Effects of faults: on values, on times, and on the delivery of events."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from estimators.log import INPUT

from .effect import Effect, Item, Moment, Target


class Silence(Effect):
    """Removes the events of its target; an input keeps its last value, which is repeated at the end of the fault."""

    def __init__(self, kind: str, target: Target, numbers: dict[str, float], rng: np.random.Generator) -> None:
        self._target = target
        self._last: float | None = None

    def set_input(self, value: float) -> None:
        """Set the value of the target, an input, when the fault is created."""
        self._last = value

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """Return the part of the event that is not affected."""
        if self._target.input is not None:
            self._last = float(item.value[self._target.input])
        if not moment.during:
            return [item]
        self.lost += 1
        return self._target.split(item)[0]

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """Return the last value of an input at the end, since it may not change for long."""
        if moment.during or self._target.input is None or self._last is None:
            return []
        value = np.full_like(item.value, np.nan)
        value[self._target.input] = self._last
        return [Item(item.at, item.arrival, INPUT, 0, value, item.at)]


class Swap(Effect):
    """Exchanges the measurements of two sensors."""

    def __init__(self, first: int, second: int) -> None:
        self._other = {first: second, second: first}

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """Return the measurement under the other sensor's name."""
        return [item.but(channel=self._other[item.channel])] if moment.during else [item]


@dataclass(frozen=True)
class ValueState:
    """Inputs of a value effect: y (ny,), the held values, seconds since the start, a hit, draws of N(0, 1) (ny,)."""

    y: np.ndarray
    held: np.ndarray
    seconds: float
    hit: bool
    draw: np.ndarray
    size: float


VALUE_EFFECTS: dict[str, Callable[[ValueState], np.ndarray]] = {
    "bias": lambda now: now.y + now.size,
    "drift": lambda now: now.y + now.size * now.seconds,
    "scale": lambda now: now.y * now.size,
    # Lost values stay lost.
    "stuck": lambda now: np.where(np.isnan(now.y), now.y, now.held),
    "spike": lambda now: now.y + now.size * now.draw if now.hit else now.y,
    "noise": lambda now: now.y + now.size * now.draw,
    "quantisation": lambda now: np.round(now.y / now.size) * now.size,
    "dropout": lambda now: np.full(now.y.size, np.nan) if now.hit else now.y,
}
"""Changed values, by kind of fault."""


class ValueEffect(Effect):
    """Changes the values of its target.

    For every event of the target it draws a number and then one for each row, whatever the kind: so the draws of a
    scheduled fault do not depend on its end, and a fault on one row leaves those of the others.
    """

    def __init__(self, kind: str, target: Target, numbers: dict[str, float], rng: np.random.Generator) -> None:
        self._change = VALUE_EFFECTS[kind]
        self._target, self._rng = target, rng
        self._size, self._rate = numbers.get("size", 0.0), numbers.get("rate", 1.0)
        self._held: dict[tuple[int, int], np.ndarray] = {}
        self._last: np.ndarray | None = None

    def set_input(self, value: float) -> None:
        """Set the value of the target, an input, when the fault is created."""
        self._last = np.array([value])

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """Return the event with changed values."""
        cells = self._target.cells(item)
        y = item.value[cells]
        if item.kind == INPUT:
            self._last = y
        return [item.with_cells(cells, self._changed(y, item, moment))]

    def _changed(self, y: np.ndarray, item: Item, moment: Moment) -> np.ndarray:
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
        changed = self._change(ValueState(y, held, moment.seconds, hit, draw, self._size))
        return np.where(self._target.touched(y.size), changed, y)

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """Return an input's value at the start and end, since it holds until it changes."""
        if self._target.input is None or self._last is None:
            return []
        value = np.full_like(item.value, np.nan)
        cells = slice(self._target.input, self._target.input + 1)
        event = Item(item.at, item.arrival, INPUT, 0, value, item.at)
        if not moment.during:
            return [event.with_cells(cells, self._last)]
        return [event.with_cells(cells, self._changed(self._last, event, replace(moment, draws=False)))]


def ns(seconds: float) -> int:
    """Return seconds as whole nanoseconds."""
    return round(seconds * 1e9)


@dataclass(frozen=True)
class TimeState:
    """Inputs of a time effect: ns since the start at arrival, seconds since it at measurement, a hit, a draw, numbers.

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
"""For each event in place of one: ns added to its stamp, and to its arrival."""


def _bursts(now: TimeState) -> Shifts:
    every = ns(now.every)
    return [(0, max(1, ceil(now.since / every)) * every - now.since)]


def _duplicate(now: TimeState) -> Shifts:
    count = now.count if now.hit else 0
    return [(ns(k * now.every), ns(k * now.every)) for k in range(count + 1)]


TIME_EFFECTS: dict[str, Callable[[TimeState], Shifts]] = {
    "delay": lambda now: [(0, ns(now.size))],
    "jitter": lambda now: [(0, ns(now.size * now.draw))],
    "bursts": _bursts,
    "duplicate": _duplicate,
    "clock_jump": lambda now: [(ns(now.size), 0)],
    "clock_drift": lambda now: [(ns(now.size * now.seconds), 0)],
}
"""Shifts of an event's times, by kind of fault."""


class TimeEffect(Effect):
    """Shifts the times of its target's events. A delayed one is delivered at its new time of arrival."""

    def __init__(self, kind: str, target: Target, numbers: dict[str, float], rng: np.random.Generator) -> None:
        self._shift = TIME_EFFECTS[kind]
        self._target, self._rng = target, rng
        self._size, self._rate = numbers.get("size", 0.0), numbers.get("rate", 1.0)
        self._every, self._count = numbers.get("every", 0.0), round(numbers.get("count", 1.0))

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """Return the event with shifted times, and its repetitions."""
        hit, draw = False, 0.0
        if moment.draws:
            hit = bool(self._rng.random() < self._rate)
            draw = float(self._rng.standard_exponential())
        if not moment.during:
            return [item]
        rest, mine = self._target.split(item)
        # A late event arrives later than it was measured.
        since = moment.since + mine.arrival - mine.at
        shifts = self._shift(TimeState(since, moment.seconds, hit, draw, self._size, self._every, self._count))
        return [*rest, *(mine.but(t=mine.t + stamp, arrival=mine.arrival + late) for stamp, late in shifts)]


class Reorder(Effect):
    """Holds an event back until the next one of its kind and channel, and delivers it after that."""

    def __init__(self, kind: str, target: Target, numbers: dict[str, float], rng: np.random.Generator) -> None:
        self._target, self._rng, self._rate = target, rng, numbers["rate"]
        self._kept: dict[tuple[int, int], Item] = {}

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """Return nothing, the event, or the event and the one before it."""
        hit = moment.draws and bool(self._rng.random() < self._rate)
        rest, mine = self._target.split(item)
        key = (mine.kind, mine.channel)
        before = self._kept.pop(key, None)
        if before is not None:
            return [*rest, mine, before.but(arrival=max(before.arrival, mine.arrival))]
        if hit and moment.during:
            self._kept[key] = mine
            return rest
        return [item]

    def flush(self) -> list[Item]:
        """Return the events without a next one."""
        kept, self._kept = list(self._kept.values()), {}
        return kept
