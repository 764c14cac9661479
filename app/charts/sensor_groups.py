"""Groups of a model's sensors: declared families, and of many sensors those of one prefix and unit."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimators.model.state_space import StateSpaceModel

from ..result import JsonObject

MANY_SENSORS = 24
"""Sensors without a family from which on they are grouped by the letters before the first digit of their names."""

MIN_MEMBERS = 4
"""Sensors of one prefix and unit that are a group."""

LISTED_MEMBERS = 8
"""Members with the largest NIS that a summary names."""

STATE_ORDER = ("stale", "degraded", "suspect", "advisory", "waiting", "tracking", "held out")
"""States of sensors, the worst first."""

ALARM_STATES = STATE_ORDER[:3]


@dataclass(frozen=True)
class SensorGroup:
    """A group: its name, the indices of its sensors, and whether it is a family, which shares entries of the tuning."""

    name: str
    members: tuple[int, ...]
    declared: bool


def sensor_groups(model: StateSpaceModel) -> tuple[SensorGroup, ...]:
    """Return the groups of at least two sensors of a model, in the order of their first sensors."""
    found: dict[tuple[str, ...], list[int]] = {}
    alone = sum(not sensor.family for sensor in model.sensors)
    for k, sensor in enumerate(model.sensors):
        if sensor.family:
            found.setdefault((sensor.family,), []).append(k)
        elif alone > MANY_SENSORS:
            prefix = re.split(r"[\W_]*\d", sensor.name, maxsplit=1)[0] or sensor.name
            found.setdefault((prefix, *(row.unit for row in sensor.rows)), []).append(k)
    kept = {key: members for key, members in found.items() if len(members) >= (2 if len(key) == 1 else MIN_MEMBERS)}
    prefixes = [key[0] for key in kept]
    return tuple(
        SensorGroup(
            key[0] if prefixes.count(key[0]) == 1 else f"{key[0]} [{', '.join(key[1:])}]", tuple(members), len(key) == 1
        )
        for key, members in kept.items()
    )


def groups_json(groups: Sequence[SensorGroup], sensors: Mapping[str, tuple[str, str]], nis: np.ndarray) -> JsonObject:
    """Return the summary of each group: number of sensors by state, mean NIS per degree of freedom, worst members.

    `sensors` has state and text of every sensor, in the model's order; `nis` the mean of its recent measurements per
    degree of freedom, NaN without any.
    """
    names, states = list(sensors), [state for state, _ in sensors.values()]
    found: JsonObject = {}
    if len(nis) != len(names):  # before the first event
        nis = np.full(len(names), np.nan)
    for group in groups:
        own = nis[list(group.members)]
        counts = Counter(states[k] for k in group.members)
        order = np.argsort(np.where(np.isfinite(own), -own, np.inf), kind="stable")[:LISTED_MEMBERS]
        found[group.name] = {
            "state": next(state for state in STATE_ORDER if counts[state]),
            "states": {state: counts[state] for state in STATE_ORDER if counts[state]},
            "alarms": sum(counts[state] for state in ALARM_STATES),
            "nis": float(np.nanmean(own)) if np.isfinite(own).any() else None,
            "worst": [[names[group.members[k]], float(own[k])] for k in order if np.isfinite(own[k])],
        }
    return found
