"""A fault at work in a stream of events: when it holds, its draws, and its stamps."""

from __future__ import annotations

import numpy as np

from estimators.log import MARK
from estimators.model.state_space import StateSpaceModel

from .effect import Effect, Item, Moment, Target
from .effects import SHIFT, SPOIL, Elsewhere, Reorder, Silence, Swap, TimeEffect, ValueEffect
from .kinds import Fault, find_kind, numbers


def _effect(fault: Fault, target: Target, rng: np.random.Generator) -> Effect:
    kind = find_kind(fault.kind).name
    if kind == "swap":
        return Swap(*target.sensors)
    if kind == "model":
        return Elsewhere()
    given = numbers(fault)
    if kind in SPOIL:
        return ValueEffect(kind, target, given, rng)
    if kind in SHIFT:
        return TimeEffect(kind, target, given, rng)
    return (Reorder if kind == "reorder" else Silence)(kind, target, given, rng)


class Active:
    """One fault from `start` until `end`, ns; which of an event's times counts is when it was truly measured.

    A `scheduled` one draws from the first event on, so that its draws do not depend on its start; one that was injected
    only from its start on, as it has not seen what was before. So both draw the same numbers when the source begins
    again. `inputs` is what was told of the inputs when it was injected.
    """

    def __init__(
        self,
        fault: Fault,
        model: StateSpaceModel,
        seed: tuple[int, int],
        start: int,
        end: int,
        *,
        scheduled: bool,
        inputs: np.ndarray,
    ) -> None:
        self.start, self.end = start, end
        self.begun = self.ended = False
        self.touched = 0
        self.since: int | None = None
        self._target = Target(fault, model)
        self._code = find_kind(fault.kind).code
        self._scheduled = scheduled
        rng = np.random.default_rng(seed if fault.seed is None else fault.seed)
        self._effect = _effect(fault, self._target, rng)
        index = self._target.input
        if index is not None and isinstance(self._effect, ValueEffect | Silence) and not np.isnan(inputs[index]):
            self._effect.told(float(inputs[index]))

    @property
    def lost(self) -> int:
        """Events that it swallowed."""
        return self._effect.lost

    def process(self, items: list[Item]) -> list[Item]:
        """What comes in place of these events, in their order, with the stamps where it begins and ends."""
        out: list[Item] = []
        for item in items:
            # A stamp is not of the asset, and says nothing of its time that an event beside it does not say.
            if item.kind == MARK:
                out.append(item)
                continue
            if not self.begun and item.at >= self.start:
                self.begun, self.since = True, item.at
                out += [self._stamp(item, self._code), *self._effect.turn(item, self._moment(item, True))]
            if self.begun and not self.ended and item.at >= self.end:
                self.ended = True
                out += [self._stamp(item, -self._code), *self._effect.turn(item, self._moment(item, False))]
            if not self._target.has(item):
                out.append(item)
                continue
            moment = self._moment(item, self.start <= item.at < self.end)
            self.touched += moment.during
            out += self._effect.apply(item, moment)
        return out

    def flush(self) -> list[Item]:
        """What it keeps back, when there is no more."""
        return self._effect.flush()

    def _moment(self, item: Item, during: bool) -> Moment:
        return Moment(during, self._scheduled or item.at >= self.start, item.at - self.start)

    def _stamp(self, item: Item, code: int) -> Item:
        value = np.full_like(item.value, np.nan)
        value[0] = code
        return Item(item.at, item.arrival, MARK, self._target.channel, value, item.at)
