"""Faults of the way that events take: what never arrives, and what comes under another name."""

from __future__ import annotations

import numpy as np

from estimators.log import INPUT

from .effect import Moment
from .item import Item
from .target import Target


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
