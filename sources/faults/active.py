"""An active fault in a stream of events: its time window, its draws, and its marks."""

from __future__ import annotations

import numpy as np

from estimators.log import MARK
from estimators.model.state_space import StateSpaceModel

from .effect import Effect, Item, Moment, Target
from .effects import TIME_EFFECTS, VALUE_EFFECTS, Reorder, Silence, Swap, TimeEffect, ValueEffect
from .kinds import Fault, find_kind, numbers


def _effect(fault: Fault, target: Target, rng: np.random.Generator) -> Effect:
    kind = find_kind(fault.kind).name
    if kind == "swap":
        return Swap(*target.sensors)
    if kind == "model":
        return Effect()  # The asset itself changes; its events pass unchanged.
    given = numbers(fault)
    if kind in VALUE_EFFECTS:
        return ValueEffect(kind, target, given, rng)
    if kind in TIME_EFFECTS:
        return TimeEffect(kind, target, given, rng)
    return (Reorder if kind == "reorder" else Silence)(kind, target, given, rng)


class ActiveFault:
    """One fault from `start` until `end`, ns, of the true time of measurement.

    A `scheduled` fault draws from the first event on, so that its draws do not depend on its start; an injected one
    from its start on, as it has not seen earlier events. So both draw the same numbers when the source begins again.
    `inputs` are the last inputs before it was injected.
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
            self._effect.set_input(float(inputs[index]))

    @property
    def lost(self) -> int:
        """Events that it removed."""
        return self._effect.lost

    def process(self, items: list[Item]) -> list[Item]:
        """Return the events in place of these, in order, with marks at its start and end."""
        out: list[Item] = []
        for item in items:
            # A mark is not an event of the asset, and has the time of the event beside it.
            if item.kind == MARK:
                out.append(item)
                continue
            if not self.begun and item.at >= self.start:
                self.begun, self.since = True, item.at
                out += [self._mark(item, self._code), *self._effect.turn(item, self._moment(item, True))]
            if self.begun and not self.ended and item.at >= self.end:
                self.ended = True
                out += [self._mark(item, -self._code), *self._effect.turn(item, self._moment(item, False))]
            if not self._target.has(item):
                out.append(item)
                continue
            moment = self._moment(item, self.start <= item.at < self.end)
            self.touched += moment.during
            out += self._effect.apply(item, moment)
        return out

    def flush(self) -> list[Item]:
        """Return the events that it still holds back at the end."""
        return self._effect.flush()

    def _moment(self, item: Item, during: bool) -> Moment:
        return Moment(during, self._scheduled or item.at >= self.start, item.at - self.start)

    def _mark(self, item: Item, code: int) -> Item:
        value = np.full_like(item.value, np.nan)
        value[0] = code
        return Item(item.at, item.arrival, MARK, self._target.channel, value, item.at)
