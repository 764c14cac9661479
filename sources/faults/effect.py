"""What every effect of a fault offers, and the moment at which it acts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from estimators.log import INPUT, READING, Events
from estimators.model.state_space import StateSpaceModel

from .kinds import Fault


@dataclass(frozen=True)
class Moment:
    """Of one event: whether the fault lasts when it is measured, whether it draws, and ns since the fault began."""

    during: bool
    draws: bool
    since: int

    @property
    def seconds(self) -> float:
        """Since the fault began."""
        return self.since / 1e9


class Effect(Protocol):
    """What a fault makes of the events of its target, in the order in which they come."""

    lost: int
    """Events that it swallowed."""

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """What comes in place of one event."""

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """What comes when the fault begins or ends, before the event with which it does."""

    def flush(self) -> list[Item]:
        """What it still keeps back when there is no more."""


READINGS_ONLY = ("stuck",)
"""Kinds that, of the whole twin, are of its sensors; the others are also of its inputs."""


class Target:
    """Finds what a fault is of. `channel` is its number in the log's stamps: sensors, then inputs, then the whole."""

    def __init__(self, fault: Fault, model: StateSpaceModel) -> None:
        self._rows = [len(sensor.rows) for sensor in model.sensors]
        self._nu = len(model.inputs)
        self._kinds: tuple[int, ...] = ()
        self._sensors: tuple[int, ...] = ()
        self._input = self._row = -1
        self.channel = len(self._rows) + self._nu
        if fault.sensor is not None:
            self.channel = model.sensor_names.index(fault.sensor)
            self._sensors = (self.channel,)
            if fault.other is not None:
                self._sensors += (model.sensor_names.index(fault.other),)
            if fault.row is not None:
                self._row = [row.name for row in model.sensors[self.channel].rows].index(fault.row)
        elif fault.input is not None:
            self._input = model.input_names.index(fault.input)
            self.channel = len(self._rows) + self._input
        elif fault.parameter is None:
            self._kinds = (READING,) if fault.kind in READINGS_ONLY else (READING, INPUT)

    @property
    def sensors(self) -> tuple[int, ...]:
        """Indices of the sensors that it names."""
        return self._sensors

    @property
    def input(self) -> int | None:
        """Index of the input, if it is one."""
        return self._input if self._input >= 0 else None

    def has(self, item: Item) -> bool:
        """Whether an event is of it; an input that an event leaves as it was is not told."""
        if self._kinds:
            return item.kind in self._kinds
        if self._input >= 0:
            return item.kind == INPUT and not np.isnan(item.value[self._input])
        return item.kind == READING and item.channel in self._sensors

    def cells(self, item: Item) -> slice:
        """The columns of an event's values that are its own, all rows of a sensor."""
        if self._input >= 0:
            return slice(self._input, self._input + 1)
        return slice(0, self._rows[item.channel] if item.kind == READING else self._nu)

    def touched(self, size: int) -> np.ndarray:
        """Which of `size` rows the fault is of, shape (size,)."""
        return np.ones(size, bool) if self._row < 0 else np.arange(size) == self._row

    def apart(self, item: Item) -> tuple[list[Item], Item]:
        """Of an event that it has: what else the event tells (of other inputs), and what it tells of the target."""
        if self._input < 0:
            return [], item
        mine = np.full_like(item.value, np.nan)
        mine[self._input] = item.value[self._input]
        rest = item.value.copy()
        rest[self._input] = np.nan
        return ([item.but(value=rest)] if not np.isnan(rest).all() else []), item.but(value=mine)


class Item:
    """An event. `at` is when it was truly measured, ns, whatever the clocks say in `t`; `value` is never written to."""

    __slots__ = ("t", "arrival", "kind", "channel", "value", "at")

    def __init__(self, t: int, arrival: int, kind: int, channel: int, value: np.ndarray, at: int) -> None:
        self.t, self.arrival, self.kind, self.channel, self.value, self.at = t, arrival, kind, channel, value, at

    def but(
        self,
        *,
        t: int | None = None,
        arrival: int | None = None,
        channel: int | None = None,
        value: np.ndarray | None = None,
    ) -> Item:
        """The same event, with these in place of its own."""
        return Item(
            self.t if t is None else t,
            self.arrival if arrival is None else arrival,
            self.kind,
            self.channel if channel is None else channel,
            self.value if value is None else value,
            self.at,
        )

    def with_cells(self, cells: slice, values: np.ndarray) -> Item:
        """The same event with other values in some columns."""
        value = self.value.copy()
        value[cells] = values
        return self.but(value=value)


def items_of(events: Events) -> list[Item]:
    """The events of a batch, one by one."""
    columns = (events.t.tolist(), events.arrival.tolist(), events.kind.tolist(), events.channel.tolist())
    return [
        Item(t, arrival, kind, channel, value, t)
        for t, arrival, kind, channel, value in zip(*columns, events.value, strict=True)
    ]


def events_of(items: Sequence[Item], width: int) -> Events:
    """Events as a batch of at least `width` value columns."""
    if not items:
        return Events.empty(width)
    widest = max(width, *(item.value.size for item in items))
    value = np.full((len(items), widest), np.nan)
    for row, item in zip(value, items, strict=True):
        row[: item.value.size] = item.value
    return Events(
        np.array([item.t for item in items], np.int64),
        np.array([item.arrival for item in items], np.int64),
        np.array([item.kind for item in items], np.int8),
        np.array([item.channel for item in items], np.int32),
        value,
    )
