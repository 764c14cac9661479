"""Colours and names that Rerun's charts, pictures and recordings share."""

from __future__ import annotations

from typing import Any

from estimators.model.state_space import StateSpaceModel

ESTIMATE = (37, 99, 235)
BAND = (147, 187, 253)
TRUTH = (22, 163, 74)
READING = (245, 158, 11)
REFUSED = (220, 38, 38)
PREVIOUS = (160, 160, 168)
EVENTS = "/events"
"""Where the lines for people are, whichever revision the charts show."""

TIMELINE = "time"

GAP = 0.05
"""Between the picture of a field and its scale, and the width of the scale, of the picture's width."""

HEALTH_COLORS = (0x60A5FAFF, 0x16A34AFF, 0xFACC15FF, 0xF59E0BFF, 0xDC2626FF, 0x9CA3AFFF)
SENSOR_COLORS = (0x60A5FAFF, 0x16A34AFF, 0xFACC15FF, 0xF59E0BFF, 0x9CA3AFFF, 0x64748BFF)
"""Of the states of a sensor, in the order of `STATES`."""


def with_unit(name: str, unit: str) -> str:
    """`gnss_speed`, `m/s` as a chart's title."""
    words = name.replace("_", " ").replace(".", " ")
    return words if unit in ("", "1") else f"{words} [{unit}]"


def row_title(model: StateSpaceModel, sensor: int, row: int) -> str:
    """Title of one sensor row."""
    return with_unit(model.row_names[model.row_start[sensor] + row], model.sensors[sensor].rows[row].unit)


def pair_name(model: StateSpaceModel, pair: Any) -> str:
    """Name of the entity of one pair of states."""
    return f"{model.state_names[pair[0]]}_{model.state_names[pair[1]]}"
