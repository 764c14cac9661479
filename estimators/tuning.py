"""The tuning: all parameters of a fold that a user may change, in one frozen, versioned object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from .errors import LARGEST, ConfigError, nearest, quoted, shown_name
from .model.state_space import StateSpaceModel, squared

_versions = count(1)

GATE_KINDS = ("hard", "soft")
"""Treatment of a measurement beyond the gate: rejected, or used with inflated noise."""

MIN_GATE = 0.5
"""Smallest probability that a good measurement passes the gate."""

REOPEN_S = 30.0
"""Default time after which a sensor that stays rejected is trusted again."""

MAX_REOPEN_S = 1e9
"""Largest value of `reopen`: 32 years."""

GATE_KEYS = {"gate": "gate", "gate.kind": "gate_kind", "gate.reopen": "reopen"}
"""Keys of the gate, and the fields that they set."""

CHANGED_MARK = "*"
"""Suffix of the name of a loaded tuning of which an entry has been changed."""

SHARED_ENTRY_ROWS = 16
"""Number of rows of a sensor from which they share one entry, `R.<sensor>`, in a panel."""


class Item(NamedTuple):
    """Entry of a tuning with its unit and range."""

    key: str
    value: float
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class Tuning:
    """Noise variances, parameters, sensors in use, gate and options of one fold.

    q (nw,) is the variance that each process noise adds per second; r (rows,) the variance of each sensor row; p (np,)
    the model's parameters; `used` (sensors,) is False for held-out sensors, which are predicted and scored, never used.
    `gate` is the probability that a good measurement passes, or None. A measurement beyond it is rejected, or, if
    `gate_kind` is "soft", used with inflated noise (gate/soften.py). For a sensor that stays rejected, the fold decides
    whether the sensor or the estimate is wrong (gate/isolation.py); if that cannot be decided, the sensor is trusted
    again after `reopen` seconds, None for never. `options` are the estimator's. `baseline` (rows, ...) is the baseline
    of the innovations when the tuning was accepted (episodes/baseline.py), None for white ones. `name` is the name
    of the loaded version, with a `*` once an entry has been changed, or empty. `version` counts the tunings of this
    process.
    """

    model: StateSpaceModel
    q: np.ndarray
    r: np.ndarray
    p: np.ndarray
    used: np.ndarray
    gate: float | None = None
    gate_kind: str = "hard"
    reopen: float | None = REOPEN_S
    options: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0
    baseline: np.ndarray | None = None
    name: str = ""
    version: int = field(default_factory=lambda: next(_versions))

    @staticmethod
    def of(model: StateSpaceModel) -> Tuning:
        """Return the tuning that a model declares."""
        return Tuning(
            model=model,
            q=np.array([noise.variance for noise in model.noises], float),
            r=np.array([row.variance for sensor in model.sensors for row in sensor.rows], float),
            p=model.default_parameters.copy(),
            used=np.ones(len(model.sensors), bool),
        )

    def items(self) -> list[Item]:
        """Return every numeric entry; many rows of one sensor, or the sensors of a family, share one, their mean."""
        return list(self._items)

    @cached_property
    def _items(self) -> list[Item]:
        model = self.model
        known: set[str] = set()  # entries of families
        items = [
            Item(f"Q.{noise.name}", float(value), noise.unit, 0.0, np.inf)
            for noise, value in zip(model.noises, self.q, strict=True)
        ]
        for sensor, start in zip(model.sensors, model.row_start, strict=True):
            own = slice(start, start + len(sensor.rows))
            names, values, unit = model.row_names[own], self.r[own], squared(sensor.rows[0].unit)
            if sensor.family:
                for name, row in zip(names, sensor.rows, strict=True):
                    key = f"R.{sensor.family}{name.removeprefix(sensor.name)}"
                    if key not in known:
                        known.add(key)
                        items.append(Item(key, _mean(self.r[self._locate(key)[1]]), squared(row.unit), 0.0, np.inf))
            elif len(values) >= SHARED_ENTRY_ROWS and len({row.unit for row in sensor.rows}) == 1:
                items.append(Item(f"R.{sensor.name}", _mean(values), unit, 0.0, np.inf))
            else:
                units = [squared(row.unit) for row in sensor.rows]
                items += [
                    Item(f"R.{name}", float(value), unit, 0.0, np.inf)
                    for name, value, unit in zip(names, values, units, strict=True)
                ]
        items += [
            Item(f"p.{parameter.name}", float(value), parameter.unit, parameter.low, parameter.high)
            for parameter, value in zip(model.parameters, self.p, strict=True)
            if parameter.listed
        ]
        return items

    def keys(self) -> list[str]:
        """Return every key of `get` and `set`."""
        rows = [f"R.{name}" for name in self.model.row_names]
        families = dict.fromkeys(sensor.family for sensor in self.model.sensors if sensor.family)
        used = [f"use.{name}" for name in (*families, *self.model.sensor_names)]
        parameters = [f"p.{parameter.name}" for parameter in self.model.parameters]
        return [*dict.fromkeys([item.key for item in self.items()] + rows + parameters), *used, *GATE_KEYS]

    def get(self, key: str) -> float | bool | str | None:
        """Return the value of a key."""
        if key in GATE_KEYS:
            value: float | str | None = getattr(self, GATE_KEYS[key])
            return value
        group, index = self._locate(key)
        return bool(np.all(self.used[index])) if group == "used" else _mean(getattr(self, group)[index])

    def set(self, key: str, value: float | bool | str | None) -> Tuning:
        """Return a new tuning with one entry changed; `R.<sensor>` sets all rows of the sensor, or of a family.

        Raises:
            ConfigError: If the key does not exist, or the value is out of range.
        """
        if key == "gate":
            number = _number(value)
            if value is not None and not MIN_GATE <= number < 1.0:
                raise ConfigError(
                    f"gate is {_shown(value)}; it must lie between {MIN_GATE:g} and 1, or be null for no gate"
                )
            return self._changed(gate=None if value is None else number)
        if key == "gate.kind":
            if value not in GATE_KINDS:
                raise ConfigError(f"gate.kind is {_shown(value)}; it must be hard or soft")
            return self._changed(gate_kind=str(value))
        if key == "gate.reopen":
            number = _number(value)
            if value is not None and not 0.0 < number <= MAX_REOPEN_S:
                raise ConfigError(
                    f"gate.reopen is {_shown(value)}; it must be a positive number of seconds, {MAX_REOPEN_S:g} at "
                    "most, or null for never"
                )
            return self._changed(reopen=None if value is None else number)
        group, index = self._locate(key)
        if group == "used":
            if not isinstance(value, (bool, np.bool_)):
                raise ConfigError(f"{key} is {_shown(value)}; it must be true or false")
            changed: np.ndarray = self.used.copy()
            changed[index] = value
        else:
            number = _number(value)
            if not np.isfinite(number):
                raise ConfigError(f"{key} is {_shown(value)}; it must be a finite number")
            if abs(number) > LARGEST:
                raise ConfigError(f"{key} is {number:g}; it must be {LARGEST:g} at most")
            if group == "q" and number < 0:
                raise ConfigError(f"{key} is {number:g}; a variance must be zero or positive")
            # All filters of a model support zero noise only where it declares that.
            if group == "r" and not (number > 0 or number == 0 and not np.any(Tuning.of(self.model).r[index])):
                raise ConfigError(
                    f"{key} is {number:g}; a variance must be positive, or zero where the model declares zero noise"
                )
            if group == "p":
                parameter = self.model.parameters[index]
                if not parameter.low <= number <= parameter.high:
                    raise ConfigError(
                        f"{key} is {number:g} {parameter.unit}; it must lie between {parameter.low:g} "
                        f"and {parameter.high:g}"
                    )
            changed = getattr(self, group).copy()
            changed[index] = number
        entry = {group: changed}
        return self._changed(**entry)

    def rows_of(self, key: str) -> np.ndarray:
        """Return the indices that an entry sets in its array: the rows of `R...`, or the places in `q` or `p`.

        Raises:
            ConfigError: If there is no such entry.
        """
        group, index = self._locate(key)
        return np.atleast_1d(np.arange(getattr(self, group).size)[index])

    def with_options(self, options: Mapping[str, float]) -> Tuning:
        """Return a new tuning with other estimator options."""
        return self._changed(options=dict(options))

    def _changed(self, **entries: Any) -> Tuning:
        name = self.name if self.name.endswith(CHANGED_MARK) else self.name and self.name + CHANGED_MARK
        changed = replace(self, version=next(_versions), name=name, **entries)
        vars(changed)["_places"] = self._places  # of the model: hundreds of kept runs share it
        return changed

    @cached_property
    def _places(self) -> dict[str, tuple[str, int]]:
        """Array and index of each single entry."""
        model = self.model
        groups = {
            "Q": ("q", [noise.name for noise in model.noises]),
            "R": ("r", model.row_names),
            "p": ("p", [parameter.name for parameter in model.parameters]),
            "use": ("used", model.sensor_names),
        }
        return {f"{key}.{name}": (of, k) for key, (of, names) in groups.items() for k, name in enumerate(names)}

    def _locate(self, key: str) -> tuple[str, Any]:
        model = self.model
        if key in self._places:
            return self._places[key]
        prefix, _, name = key.partition(".")
        if prefix == "R" and name in model.sensor_names:
            k = model.sensor_names.index(name)
            return "r", slice(model.row_start[k], model.row_start[k] + len(model.sensors[k].rows))
        members = [k for k, sensor in enumerate(model.sensors) if sensor.family and name.split(".")[0] == sensor.family]
        if prefix == "use" and members and name == model.sensors[members[0]].family:
            return "used", members
        if prefix == "R" and members:
            family, _, row = name.partition(".")
            wanted = {f"{model.sensors[k].name}.{row}" if row else "" for k in members}
            rows = [
                model.row_start[k] + j
                for k in members
                for j in range(len(model.sensors[k].rows))
                if not row or model.row_names[model.row_start[k] + j] in wanted
            ]
            if rows:
                return "r", rows
        raise ConfigError(f"{shown_name(key)} is not a tuning key of {model.name}; {nearest(key, self.keys())}")


def _number(value: float | bool | str | None) -> float:
    """Return a value as a number; NaN if it is not one."""
    return float("nan") if value is None or isinstance(value, (str, bool, np.bool_)) else float(value)


def _shown(value: float | bool | str | None) -> str:
    """Format a value for a message as YAML and JSON do."""
    if value is None:
        return "null"
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    return quoted(value) if isinstance(value, str) else f"{value:g}"


def _mean(values: np.ndarray) -> float:
    """Return the mean of values; exactly their common value if they are equal."""
    first = np.ravel(values)[0]
    return float(first if np.all(values == first) else np.mean(values))
