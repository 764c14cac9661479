"""Where Rerun shows what of a large field: pictures above, a few cells over time, what the errors come to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from estimators.model.state_space import StateSpaceModel

from ...present.drawing.heatmap import Frame, kinds
from ...present.drawing.palette import Palette
from .style import GAP


def pictures(model: StateSpaceModel, root: str, *, truth: bool) -> rrb.Horizontal:
    """Estimate, deviation, and error with the truth behind it in a tab."""
    grid = model.grid
    assert grid is not None
    frame = Frame.of(grid)
    bounds = rrb.VisualBounds2D(
        x_range=(-0.04 * frame.width, (1.2 + 2 * GAP) * frame.width),
        y_range=(-0.06 * frame.height, 1.06 * frame.height),
    )
    views = {
        kind.name: rrb.Spatial2DView(
            origin=f"{root}/field/{kind.name}",
            name=f"{kind.brief} [{grid.unit}]",
            visual_bounds=bounds,
        )
        for kind in kinds(truth)
    }
    if not truth:
        return rrb.Horizontal(*views.values())
    return rrb.Horizontal(views["estimate"], views["std"], rrb.Tabs(views["error"], views["truth"]))


def sums(model: StateSpaceModel, chart: Callable[..., Any], *, truth: bool) -> list[Any]:
    """Charts of what all cells, and all rows of each sensor, come to."""
    assert model.grid is not None
    title = "RMSE, spread of all cells" if truth else "spread of all cells"
    found = [chart(f"{title} [{model.grid.unit}]", ["/field/rmse", "/field/spread"])]
    for sensor in model.sensors:
        words = f"{sensor.name.replace('_', ' ')}: " if len(model.sensors) > 1 else ""
        found.append(chart(f"{words}innovations / σ: rms, largest", [f"/innovation/{sensor.name}"]))
    return found


def styles(style: Callable[[str, Any], None], model: StateSpaceModel, palette: Palette) -> None:
    """How the lines of a field are drawn."""
    style("/field/rmse", rr.SeriesLines(colors=[palette.truth], names=["RMSE"], widths=[2.0]))
    style("/field/spread", rr.SeriesLines(colors=[palette.estimate], names=["spread"], widths=[2.0]))
    for sensor in model.sensors:
        style(
            f"/innovation/{sensor.name}",
            rr.SeriesLines(colors=[palette.reading, palette.refused], names=["rms", "largest"], widths=[2.0, 1.0]),
        )
