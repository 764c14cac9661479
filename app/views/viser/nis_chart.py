"""The chart of Viser's own window: NIS in its bounds, some 200 points, at most twice a second."""

from __future__ import annotations

import numpy as np
import viser

from ...present.drawing.geometry import round_step
from ...present.drawing.palette import LIGHT, RGB
from ...present.series.columns import LINE, LOWER, UPPER
from ...present.series.lane import drawn
from ...present.series.pyramid import FACTOR, grouped
from .history import History
from .time_units import Unit

COLUMNS = {"nis_high": UPPER, "nis_low": LOWER, "nis_mean": LINE}

GROUPS = 100
"""Groups of rows that are drawn at most, each as two points."""

HIGHEST = 4.0
"""Times the upper bound, up to which the mean is drawn."""


class NisChart:
    """The mean NIS of the last readings, between the bounds that a consistent filter keeps."""

    def __init__(self, gui: viser.GuiApi, unit: Unit) -> None:
        self._unit = unit
        none, line = "rgba(0,0,0,0)", {"spanGaps": True, "points": {"show": False}}
        axis = {"font": "11px sans-serif", "stroke": _css(LIGHT.previous), "ticks": {"size": 4}}
        below = {"size": 24, "label": f"time [{unit.name}]", "labelSize": 14, "labelFont": "11px sans-serif"}
        nothing = np.full(2, np.nan)
        self.handle = gui.add_uplot(
            (np.array([0.0, 1.0]), *(nothing for _ in COLUMNS), np.array([0.0, 1.0])),
            (
                {"label": "time"},
                {"label": "high", "stroke": none, "auto": False, **line},
                {"label": "low", "stroke": none, "auto": False, **line},
                {"label": "mean", "stroke": _css(LIGHT.estimate), "width": 1.5, "auto": False, **line},
                # uPlot finds no range of a series with NaN; this one is not seen and spans it for all.
                {"label": "range", "stroke": none, "width": 0, "points": {"show": False}},
            ),  # type: ignore[arg-type]
            title="NIS: mean of the last readings, 95 % bounds",
            bands=({"series": (1, 2), "fill": "rgba({},{},{},0.22)".format(*LIGHT.bound)},),
            scales={"x": {"time": False}},
            axes=(axis | below, axis | {"size": 44}),
            legend={"show": False},
            height=170,
            padding=(4, 14, 0, 0),
        )

    def draw(self, history: History, origin: int) -> None:
        """Send what the history holds, over time since `origin`, ns."""
        values = np.stack([history.column(name) for name in COLUMNS], axis=1)
        # Arrays of numbers have no gaps for uPlot: what was before one is left out, not joined by a line.
        gaps = np.flatnonzero(~np.isfinite(values[:, 2]))
        start = int(gaps[-1]) + 1 if gaps.size else 0
        rows, size = len(values) - start, 1
        if rows < 2:
            self.handle.data = (np.array([0.0, 1.0]), *(np.full(2, np.nan) for _ in COLUMNS), np.array([0.0, 1.0]))
            return
        while rows > GROUPS * size:
            size *= FACTOR
        groups = grouped(size, history.base + start, history.column("t")[start:], values[start:])
        times, points = drawn(groups, np.array(list(COLUMNS.values())))
        highest = float(points[:, 0].max())
        # A bad start must not flatten the rest: what lies far above the bounds is drawn at the top.
        top = round_step(1.2 * max(highest, min(HIGHEST * highest, float(points[:, 2].max()))))
        columns = np.minimum(points, top)
        ends = np.where(np.arange(times.size) % 2 == 0, 0.0, top)
        self.handle.data = ((times - origin) * (1e-9 / self._unit.seconds), *columns.T, ends)


def _css(color: RGB) -> str:
    return "rgb({},{},{})".format(*color)
