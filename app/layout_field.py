"""Where Rerun shows what of a large field: pictures above, a few cells over time, what the errors come to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from estimators.model import StateSpaceModel

from .heatmap import Frame, kinds
from .rerun_field import GAP

CELLS_AT_ONCE = 2
"""Charts of cells shown at the same time; more come in tabs."""

RMSE, SPREAD = (22, 163, 74), (37, 99, 235)


def pictures(model: StateSpaceModel, root: str, *, truth: bool) -> rrb.Horizontal:
    """Estimate, deviation, and error with the truth behind it in a tab."""
    grid = model.grid
    assert grid is not None
    frame = Frame.of(grid)
    bar = max(3, round(GAP * frame.width))
    bounds = rrb.VisualBounds2D(
        x_range=(-0.04 * frame.width, 1.16 * frame.width + 2 * bar), y_range=(-0.06 * frame.height, 1.06 * frame.height)
    )
    name = grid.name.replace("_", " ")
    views = {
        kind.name: rrb.Spatial2DView(
            origin=f"{root}/field/{kind.name}",
            name=f"{name}: {kind.title} [{grid.unit}]",
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
    title = "RMSE and spread of all cells" if truth else "spread of all cells"
    found = [chart(f"{title} [{model.grid.unit}]", ["/field/rmse", "/field/spread"])]
    for sensor in model.sensors:
        words = sensor.name.replace("_", " ")
        found.append(chart(f"{words}: innovations / σ, rms and largest", [f"/innovation/{sensor.name}"]))
    return found


def styles(style: Callable[[str, Any], None], model: StateSpaceModel) -> None:
    """How the lines of a field are drawn."""
    style("/field/rmse", rr.SeriesLines(colors=[RMSE], names=["RMSE"], widths=[2.0]))
    style("/field/spread", rr.SeriesLines(colors=[SPREAD], names=["spread"], widths=[2.0]))
    for sensor in model.sensors:
        style(
            f"/innovation/{sensor.name}",
            rr.SeriesLines(colors=[(245, 158, 11), (220, 38, 38)], names=["rms", "largest"], widths=[2.0, 1.0]),
        )
