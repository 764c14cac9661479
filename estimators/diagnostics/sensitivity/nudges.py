"""Nudges: what could be off or drift, by how much it is moved to see what follows, and how it is moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...log import INPUT, READING, Log
from ...model.state_space import StateSpaceModel
from ...snapshots import Base
from ...tuning import Tuning

SENSOR, INPUT_, PARAMETER = KINDS = ("sensor", "input", "parameter")

DRIFT = "drift"
"""Of a sensor row, too: its readings move away from the log's first event on, by so much a second."""

STEP = 1e-3
"""Of the scale of what is nudged: the error of a central difference is of the order of its square, and rounding of the
order of 1e-16 over it."""


class Nudge(NamedTuple):
    """A constant, or a drift, added to the readings of a sensor row; a constant added to an input or a parameter.

    `step` is what is added and taken off for the differences, `low` and `high` the range in which a fault of this kind
    (a change from the present value) makes sense, `scale` the size by which nudges are compared: the deviation of the
    sensor's noise, the spread of the input in the log, the parameter's value, or its range where that is 0. `value` is
    a parameter's own. All in `unit`.
    """

    kind: str
    name: str
    unit: str
    step: float
    low: float
    high: float
    scale: float
    value: float = np.nan

    def in_words(self, size: float) -> str:
        """A fault of a size: of a parameter in percent of its value, if it has one; else in units."""
        if self.kind == PARAMETER and self.value:
            return f"{self.name} {100.0 * size / abs(self.value):+.3g} %"
        if self.kind == DRIFT:
            return f"{SENSOR} {self.name} drifting by {size:+.3g} {self.unit}"
        kind = "" if self.kind == PARAMETER else f"{self.kind} "
        return f"{kind}{self.name} {size:+.3g} {self.unit}"

    @property
    def largest(self) -> float:
        """Size of the largest fault within the range."""
        return max(abs(self.low), abs(self.high))


class Given(NamedTuple):
    """What a fold is given: any of it may be nudged."""

    tuning: Tuning
    log: Log
    base: Base


def nudges_of(model: StateSpaceModel, tuning: Tuning, log: Log, kinds: Sequence[str] = KINDS) -> list[Nudge]:
    """Every nudge of a model: rows of sensors that speak and are used, inputs, parameters with room in their range."""
    found = []
    seconds = float(log.t[log.n - 1] - log.t[0]) * 1e-9 if log.n else 0.0
    units = [row.unit for sensor in model.sensors for row in sensor.rows]
    kind, channel = log.kind[: log.n], log.channel[: log.n]
    speak = tuning.used & np.isin(np.arange(len(model.sensors)), channel[kind == READING])
    in_use = np.repeat(speak, [len(sensor.rows) for sensor in model.sensors])
    for name, unit, variance, used in zip(model.row_names, units, tuning.r, in_use, strict=True):
        if used:
            scale = float(np.sqrt(variance)) or 1.0
            found.append(Nudge(SENSOR, name, unit, STEP * scale, -np.inf, np.inf, scale))
            if seconds > 0.0:
                rate = scale / seconds
                found.append(Nudge(DRIFT, name, f"{unit}/s", STEP * rate, -np.inf, np.inf, rate))
    given = log.value[: log.n][kind == INPUT]
    for k, item in enumerate(model.inputs):
        values = given[np.isfinite(given[:, k]), k]
        values = values if values.size else np.array([item.default])
        scale = float(np.std(values)) or float(np.abs(values[0])) or 1.0
        found.append(Nudge(INPUT_, item.name, item.unit, STEP * scale, -np.inf, np.inf, scale))
    for parameter, value in zip(model.parameters, tuning.p.tolist(), strict=True):
        low, high = parameter.low - value, parameter.high - value
        scale = abs(value) or (high - low if np.isfinite(high - low) else 1.0)
        if low < high:
            found.append(Nudge(PARAMETER, parameter.name, parameter.unit, STEP * scale, low, high, scale, value))
    return [nudge for nudge in found if nudge.kind in kinds]


def nudged(given: Given, nudge: Nudge, size: float) -> Given:
    """What a fold is given, with `size` added to what the nudge names; nothing that was given changes."""
    tuning, log, base = given
    model = tuning.model
    if nudge.kind == PARAMETER:
        p = tuning.p.copy()
        p[[item.name for item in model.parameters].index(nudge.name)] += size
        return Given(replace(tuning, p=p), log, base)
    other = log.copy()
    kind, value = other.kind[: other.n], other.value[: other.n]
    if nudge.kind in (SENSOR, DRIFT):
        row = model.row_names.index(nudge.name)
        sensor = int(np.searchsorted(model.row_start, row, side="right")) - 1
        own = np.flatnonzero((kind == READING) & (other.channel[: other.n] == sensor))
        off = size if nudge.kind == SENSOR else size * 1e-9 * (other.t[own] - other.t[0])
        value[own, row - model.row_start[sensor]] += off
        return Given(tuning, other, base)
    k = model.input_names.index(nudge.name)
    value[kind == INPUT, k] += size
    u = base.u.copy()
    u[k] += size
    return Given(tuning, other, base._replace(u=u))
