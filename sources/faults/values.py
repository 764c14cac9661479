"""Faults of what is said: bias, drift, scale, stuck, spikes, noise, quantisation, dropout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from estimators.log import INPUT

from .effect import Moment
from .item import Item
from .target import Target


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
