"""Names and colours that Rerun's charts, pictures and recordings share; the colours are the page's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from estimators.model.state_space import StateSpaceModel

from ...present.drawing.palette import RGB, Palette, mixed

EVENTS = "/events"
"""Where the lines for people are, whichever revision the charts show."""

TIMELINE = "time"

GAP = 0.05
"""Between the picture of a field and its scale, and the width of the scale, of the picture's width."""


def state_colors(names: Sequence[str], palette: Palette) -> np.ndarray:
    """Colours of states of health, as Rerun packs them (n,) uint32; what is no health is grey."""
    colors = [palette.health.get(name, palette.faint) for name in names]
    return np.array([(r << 24) | (g << 16) | (b << 8) | 255 for r, g, b in colors], np.uint32)


def band_color(palette: Palette) -> RGB:
    """Of the lines at ± 2 σ, and of what else belongs to the estimate but is not the line itself."""
    return mixed(palette.estimate, palette.panel, 0.45)


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
