"""How uPlot draws the charts: the series of each, axes and frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from .time_units import Unit

BLUE, GREEN, GREY, RED = "#2563eb", "#16a34a", "#9ca3af", "#dc2626"
DOTS = ("#f59e0b", "#8b5cf6", "#0891b2")
HEIGHT = 130


def line(color: str, width: float, **more: Any) -> dict[str, Any]:
    """A series that is drawn as a line, over gaps too: uPlot knows none in arrays of numbers (see `runs`)."""
    return {"stroke": color, "width": width, "auto": False, "spanGaps": True, "points": {"show": False}, **more}


def frame_series() -> dict[str, Any]:
    """A series that is not seen."""
    # uPlot finds no range of a series with NaN. So this invisible one, which has none, spans the range for all.
    return {"label": "range", "stroke": "rgba(0,0,0,0)", "width": 0, "points": {"show": False}}


def dots(color: str, size: float) -> dict[str, Any]:
    """A series that is drawn as dots."""
    # A line of no width: uPlot draws the points only.
    return {
        "stroke": color,
        "width": 0,
        "auto": False,
        "points": {"show": True, "size": size, "fill": color, "width": 0},
    }


def rings(color: str, size: float) -> dict[str, Any]:
    """A series that is drawn as rings."""
    ring = dots(color, size)
    return {**ring, "points": {**ring["points"], "fill": "rgba(0,0,0,0)", "width": 1.5}}


BAND = (line("rgba(0,0,0,0)", 0, label="high"), line("rgba(0,0,0,0)", 0, label="low"))
"""The edges between which a band is filled, not seen themselves."""


def state_series(before: int, means: int) -> tuple[dict[str, Any], ...]:
    """The series of a state's chart, of which the previous and the present mean come in some runs."""
    return (
        {"label": "time"},
        *BAND,
        *(dots(color, 4) for color in DOTS),
        *(line(GREY, 1, label="previous") for _ in range(before)),
        line(GREEN, 1.5, label="truth"),
        *(line(BLUE, 1.5, label="mean") for _ in range(means)),
        dots(RED, 5),
        rings(RED, 7),
        frame_series(),
    )


def nis_series(count: int) -> tuple[dict[str, Any], ...]:
    """The series of the NIS chart, of which the windowed mean and its bounds come in some runs."""
    return (
        {"label": "time"},
        *BAND,
        *(line(GREY, 1, dash=(4, 4), label="bound") for _ in range(2 * count)),
        *(line(BLUE, 1.5, label="windowed mean") for _ in range(count)),
        dots("#94a3b8", 3),
        frame_series(),
    )


def send(chart: viser.GuiUplotHandle, data: list[np.ndarray], series: tuple[dict[str, Any], ...]) -> None:
    """Give a chart its columns; the series too where they changed, which rebuilds it."""
    if chart.series != series:
        chart.series = series  # type: ignore[assignment]
    chart.data = tuple(data)


def no_data(series: int) -> tuple[np.ndarray, ...]:
    """Empty axes: all NaN but the times and the range."""
    ends = np.array([0.0, 1.0])
    return ends, *(np.full(2, np.nan) for _ in range(series - 2)), ends


def axes(unit: Unit) -> tuple[dict[str, Any], dict[str, Any]]:
    """Time below, in a unit, and values to the left."""
    axis = {"font": "11px sans-serif", "ticks": {"size": 4}}
    below = {"size": 22, "label": unit.name, "labelSize": 12, "labelGap": -2, "labelFont": "11px sans-serif"}
    return {**axis, **below}, {**axis, "size": 52}


def frame(height: int, unit: Unit) -> dict[str, Any]:
    """Axes, height and margins of a chart."""
    return {
        "scales": {"x": {"time": False}},
        "axes": axes(unit),
        "legend": {"show": False},
        "height": height,
        "padding": (4, 14, 0, 0),
    }
