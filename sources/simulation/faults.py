"""Faults of simulated sensors: what a reading becomes while its sensor fails.

Each fault has draws of its own, made from the simulation's seed and its place in the list, one of each kind for every
reading of its sensor. So a fault changes nothing but its sensor's readings while it lasts, and moving its ends, or
adding another after it, leaves its draws as they were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from estimators.errors import SourceError
from estimators.model.state_space import Sensor

KINDS = ("bias", "drift", "stuck", "outliers", "dropout")


@dataclass(frozen=True)
class Fault:
    """One fault of a sensor, from `start` until `end`, in seconds of the simulation.

    bias: `size` is added, in the row's unit. drift: `size` is added for every second since `start`. stuck: the last
    reading before `start` is repeated; if there was none, the first after it. outliers: with probability `rate` a draw
    of N(0, size²) is added. dropout: with probability `rate` the reading is lost.

    `row` names one row of the sensor, None means all; a dropout loses whole readings.
    """

    sensor: str
    kind: str
    start: float = 0.0
    end: float = inf
    size: float = 0.0
    rate: float = 1.0
    row: str | None = None


class Faults:
    """The faults of a simulation, applied to its readings in the order in which they are given.

    Raises:
        SourceError: If a fault names a sensor, row or kind that there is not, or its numbers are out of range.
    """

    def __init__(self, faults: Sequence[Fault], sensors: Sequence[Sensor], seed: int) -> None:
        names = [sensor.name for sensor in sensors]
        self._by_sensor: list[list[_Active]] = [[] for _ in sensors]
        for k, fault in enumerate(faults):
            told = f"simulator: fault {k + 1}"
            if fault.sensor not in names:
                raise SourceError(f"{told}: there is no sensor {fault.sensor!r}; choose from {', '.join(names)}")
            index = names.index(fault.sensor)
            rows = [row.name for row in sensors[index].rows]
            if fault.row is not None and fault.row not in rows:
                raise SourceError(f"{told}: {fault.sensor} has no row {fault.row!r}; choose from {', '.join(rows)}")
            if fault.kind not in KINDS:
                raise SourceError(f"{told}: kind is {fault.kind!r}; choose from {', '.join(KINDS)}")
            if not fault.start < fault.end:
                raise SourceError(f"{told}: it ends at {fault.end} s; that must be after its start, {fault.start} s")
            if not 0.0 <= fault.rate <= 1.0:
                raise SourceError(f"{told}: rate is {fault.rate}; it is a probability, 0 to 1")
            touched = np.array([fault.row in (None, row) for row in rows])
            self._by_sensor[index].append(_Active(fault, touched, np.random.default_rng((seed, k))))

    def spoil(self, sensor: int, t: float, y: np.ndarray) -> np.ndarray:
        """What a sensor says in place of y (ny,), t seconds after the start; NaN is lost."""
        for active in self._by_sensor[sensor]:
            y = active.spoil(t, y)
        return y


class _Active:
    """A fault with its draws, and the reading at which its sensor sticks."""

    def __init__(self, fault: Fault, touched: np.ndarray, rng: np.random.Generator) -> None:
        self._fault, self._touched, self._rng = fault, touched, rng
        self._held: np.ndarray | None = None

    def spoil(self, t: float, y: np.ndarray) -> np.ndarray:
        fault = self._fault
        hit = self._rng.random() < fault.rate
        draw = self._rng.standard_normal(y.size)
        during = fault.start <= t < fault.end
        if not during or self._held is None:
            self._held = y
        if not during:
            return y
        if fault.kind == "stuck":
            return np.where(self._touched, self._held, y)
        if fault.kind == "dropout":
            return np.full(y.size, np.nan) if hit else y
        added = {
            "bias": fault.size,
            "drift": fault.size * (t - fault.start),
            "outliers": fault.size * draw if hit else 0.0,
        }[fault.kind]
        return np.where(self._touched, y + added, y)
