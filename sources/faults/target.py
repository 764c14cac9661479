"""Which events a fault is of, and which of their values."""

from __future__ import annotations

import numpy as np

from estimators.log import INPUT, READING
from estimators.model.state_space import StateSpaceModel

from .fault import Fault
from .item import Item

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
