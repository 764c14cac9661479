"""Events one by one, the target of a fault, and the interface of its effect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimators.log import INPUT, READING, Events
from estimators.model.state_space import StateSpaceModel

from .kinds import Fault


class Item:
    """An event. `at` is its true time of measurement, ns, whatever the stamp `t`; `value` is never written to."""

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
        """Return a copy with these fields replaced."""
        return Item(
            self.t if t is None else t,
            self.arrival if arrival is None else arrival,
            self.kind,
            self.channel if channel is None else channel,
            self.value if value is None else value,
            self.at,
        )

    def with_cells(self, cells: slice, values: np.ndarray) -> Item:
        """Return a copy with other values in some columns."""
        value = self.value.copy()
        value[cells] = values
        return self.but(value=value)


def items_of(events: Events) -> list[Item]:
    """Return the events of a batch, one by one."""
    columns = (events.t.tolist(), events.arrival.tolist(), events.kind.tolist(), events.channel.tolist())
    return [
        Item(t, arrival, kind, channel, value, t)
        for t, arrival, kind, channel, value in zip(*columns, events.value, strict=True)
    ]


def events_of(items: Sequence[Item], width: int) -> Events:
    """Return events as a batch of at least `width` value columns."""
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


class Target:
    """Events and values that a fault affects. `channel` is its number in the log's marks: sensors, inputs, all."""

    def __init__(self, fault: Fault, model: StateSpaceModel) -> None:
        self._rows = [len(sensor.rows) for sensor in model.sensors]
        self._nu = len(model.inputs)
        self._kinds: tuple[int, ...] = ()
        self.sensors: tuple[int, ...] = ()
        self.input: int | None = None
        self._row: int | None = None
        self.channel = len(self._rows) + self._nu
        if fault.sensor is not None:
            self.channel = model.sensor_names.index(fault.sensor)
            self.sensors = (self.channel,)
            if fault.other is not None:
                self.sensors += (model.sensor_names.index(fault.other),)
            if fault.row is not None:
                self._row = [row.name for row in model.sensors[self.channel].rows].index(fault.row)
        elif fault.input is not None:
            self.input = model.input_names.index(fault.input)
            self.channel = len(self._rows) + self.input
        elif fault.parameter is None:
            # Of the whole twin, a stuck fault affects the sensors only.
            self._kinds = (READING,) if fault.kind == "stuck" else (READING, INPUT)

    def has(self, item: Item) -> bool:
        """Return whether an event is affected; one that leaves an input unchanged is not."""
        if self._kinds:
            return item.kind in self._kinds
        if self.input is not None:
            return item.kind == INPUT and not np.isnan(item.value[self.input])
        return item.kind == READING and item.channel in self.sensors

    def cells(self, item: Item) -> slice:
        """Return the affected columns of an event's values, all rows of a sensor."""
        if self.input is not None:
            return slice(self.input, self.input + 1)
        return slice(0, self._rows[item.channel] if item.kind == READING else self._nu)

    def touched(self, size: int) -> np.ndarray:
        """Return which of `size` rows are affected, shape (size,)."""
        return np.ones(size, bool) if self._row is None else np.arange(size) == self._row

    def split(self, item: Item) -> tuple[list[Item], Item]:
        """Return the unaffected part of an event (other inputs), if there is one, and the affected part."""
        if self.input is None:
            return [], item
        mine = np.full_like(item.value, np.nan)
        mine[self.input] = item.value[self.input]
        rest = item.value.copy()
        rest[self.input] = np.nan
        return ([item.but(value=rest)] if not np.isnan(rest).all() else []), item.but(value=mine)


@dataclass(frozen=True)
class Moment:
    """State of the fault at an event: whether it is active, whether it draws, and ns since it began."""

    during: bool
    draws: bool
    since: int

    @property
    def seconds(self) -> float:
        """Seconds since the fault began."""
        return self.since / 1e9


class Effect:
    """Effect of a fault on the events of its target, in their order of arrival; by default none."""

    lost = 0
    """Events that it removed."""

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """Return the events in place of one event."""
        return [item]

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """Return the events to insert before the event with which the fault begins or ends."""
        return []

    def flush(self) -> list[Item]:
        """Return the events that are still held back at the end."""
        return []
