"""A chart of a large field: the spread of all cells, and the root mean square of their errors where it is known."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import viser

from estimators.diagnostics.field_pictures import Picture
from estimators.model.field import Field

from .charts import RUNS, Range
from .decimate import runs
from .history import History
from .series import BLUE, GREEN, HEIGHT, axes, frame, frame_series, line, no_data, send
from .time_units import Unit


class FieldChart:
    """Spread against error: an honest filter's lines lie on each other."""

    def __init__(self, gui: viser.GuiApi, field: Field, unit: Unit, *, truth: bool) -> None:
        self._range, self._unit = Range(), unit
        series = _series(1)
        what = "RMSE (green) and spread (blue) of all cells" if truth else "spread of all cells"
        self._chart = gui.add_uplot(
            no_data(len(series)),
            series,  # type: ignore[arg-type]
            title=f"{what} [{field.unit}]",
            **frame(HEIGHT, unit),
        )

    def draw(self, pictures: Iterable[Picture], history: History, window: float | None, unit: Unit) -> None:
        """Send the numbers of the pictures in the last `window` seconds, over time in a unit."""
        t = history.column("t")
        if not t.size or history.origin is None:
            return
        since = -np.inf if window is None else t[-1] - window * 1e9
        chosen = [picture for picture in pictures if picture.t >= since]
        if len(chosen) < 2:
            return
        if unit != self._unit:
            self._unit, self._chart.axes = unit, axes(unit)
        x = (np.array([picture.t for picture in chosen]) - history.origin) * (1e-9 / unit.seconds)
        rmse, spread = (np.array([getattr(picture, name) for picture in chosen]) for name in ("rmse", "spread"))
        ends = self._range.series([rmse, spread, np.zeros(len(chosen))])
        known = np.isfinite(spread)
        errors, spreads = runs(rmse, known, RUNS), runs(spread, known, RUNS)
        send(self._chart, [x, *errors, *spreads, ends], _series(len(spreads)))


def _series(count: int) -> tuple[dict[str, Any], ...]:
    """The series of the chart, of which both lines come in some runs."""
    errors = (line(GREEN, 1.5, label="RMSE") for _ in range(count))
    spreads = (line(BLUE, 1.5, label="spread") for _ in range(count))
    return {"label": "time"}, *errors, *spreads, frame_series()
