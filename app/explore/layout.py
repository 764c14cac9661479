"""What Rerun shows where: entity paths, colours, and the blueprint of the right side of the page."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from estimators.model.state_space import StateSpaceModel
from estimators.numerics.quantiles import chi_square_quantile

from ..charts.colors import EITHER, RGB, Palette, PictureFrame, kinds
from ..charts.direct_readings import measured_by
from .sink import NOTICES_PATH, SCALE_GAP, TIMELINE, band_color, pair_name, row_title, with_unit

MAX_SENSOR_LANES = 6  # Sensors at most whose states are drawn, below the twin's health

MAX_VISIBLE_CHARTS = 3
"""Charts of states that are shown at the same time; more come in tabs, which cost nothing while they are hidden."""


def nis_limit(model: StateSpaceModel) -> float:
    """Return the top of the NIS chart, which 1 % of consistent measurements exceed; spikes are cut off."""
    return float(chi_square_quantile(0.99, max(len(sensor.rows) for sensor in model.sensors)))


def blueprint(
    model: StateSpaceModel, pairs: np.ndarray, *, window: float, root: str = "", truth: bool = False
) -> rrb.Blueprint:
    """The layout of the charts, which show the last `window` seconds.

    `pairs` (k, 2) has indices of the states of each ellipse, `root` is the path before all entities, and `truth` tells
    whether the truth of a whole large field is known.
    """
    span = rr.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-window),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.02 * window),
    )
    axis = rrb.TimeAxis(view_range=span)

    def chart(name: str, contents: list[str], **more: object) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=f"{root}/", contents=[f"+ {root}{path}" for path in contents], name=name, axis_x=axis,
            plot_legend=rrb.PlotLegend(visible=False), **more,
        )  # fmt: skip

    measured = measured_by(model)
    states = []
    for state in model.shown_states:
        rows = measured.get(state.name, [])
        over = [f"/{kind}/{row}" for row in rows for kind in ("reading", "refused", "screened")]
        lines = [f"{above}/state/{state.name}" for above in ("/previous", "/smoothed", "")]
        contents = [*over, *lines, f"/truth/{state.name}"]
        states.append(chart(with_unit(model.label(state.name), state.unit), contents))
    if model.grid is not None:
        innovations = field_charts(model, chart, truth=truth)
    else:
        innovations = [
            chart(f"innovation: {row_title(model, k, r)}", [f"/innovation/{model.row_names[model.row_start[k] + r]}"])
            for k, sensor in enumerate(model.sensors)
            for r in range(len(sensor.rows))
        ]
    nis = chart(
        "NIS, windowed mean in its 95 % bounds",
        ["/nis/reading", "/previous/nis", "/nis/window"],
        # From a little below zero, whose label would overlap that of the time.
        axis_y=rrb.ScalarAxis(range=(-0.08 * nis_limit(model), nis_limit(model)), zoom_lock=True),
    )
    lanes = len(model.sensors) if len(model.sensors) <= MAX_SENSOR_LANES else 0
    health = rrb.StateTimelineView(
        origin=f"{root}/",
        contents=[f"+ {root}/health", *([f"+ {root}/sensor/**"] if lanes else [])],
        name="health and sensors" if lanes else "health",
        time_view=axis,
    )
    columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["LogLevel", "Body"])
    events = rrb.TextLogView(origin=NOTICES_PATH, name="events", columns=columns)
    ellipses = [
        rrb.Spatial2DView(
            origin=f"{root}/pair/{pair_name(model, pair)}",
            name=" · ".join(with_unit(model.states[j].name, model.states[j].unit) for j in pair) + ", 2σ",
        )
        for pair in pairs
    ]
    bottom = rrb.Horizontal(*_tabs(ellipses), events, column_shares=[1.0] * (bool(ellipses) + 1))
    if model.grid is not None:
        above = [
            field_pictures(model, root, truth=truth),
            rrb.Horizontal(*_tabs(states), innovations[0]),
            rrb.Horizontal(nis, *_tabs(innovations[1:])),
        ]
        shares = [2.6, 1.5, 1.5, 0.75, 0.9]
    else:
        charts = _stacked(states)
        above = [*charts, rrb.Horizontal(*_tabs(innovations), nis)]
        # As high as the lanes, of which those of up to three sensors are read at once.
        height = 0.75 + 0.4 * min(lanes, MAX_VISIBLE_CHARTS)
        shares = [1.25 * min(len(states), MAX_VISIBLE_CHARTS) / len(charts)] * len(charts) + [1.1, height, 1.5]
    return rrb.Blueprint(
        rrb.Vertical(*above, health, bottom, row_shares=shares),
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )  # fmt: skip


def _tabs(views: list[rrb.View | rrb.Container]) -> list[rrb.View | rrb.Container]:
    return views if len(views) < 2 else [rrb.Tabs(*views)]


def _stacked(views: list[rrb.View | rrb.Container]) -> list[rrb.View | rrb.Container]:
    """Views one above the other; if they are many, in tabs that hold as many as one can read at once."""
    if len(views) <= MAX_VISIBLE_CHARTS:
        return views
    groups = [views[k : k + MAX_VISIBLE_CHARTS] for k in range(0, len(views), MAX_VISIBLE_CHARTS)]
    return [
        rrb.Tabs(
            *(rrb.Vertical(*group, name=", ".join(str(view.name).split(" [")[0] for view in group)) for group in groups)
        )
    ]


def styles(
    stream: rr.RecordingStream, model: StateSpaceModel, pairs: np.ndarray, root: str = "", palette: Palette = EITHER
) -> None:
    """Log how everything is drawn; static, so that it holds at every time."""

    def style(path: str, what: rr.AsComponents) -> None:
        stream.log(f"{root}{path}", what, static=True)

    light, grey = band_color(palette), palette.previous

    def band(name: str, color: RGB) -> rr.SeriesLines:
        return rr.SeriesLines(colors=[color, light, light], names=[name, "+2σ", "−2σ"], widths=[2.0, 1.0, 1.0])

    previous = rr.SeriesLines(colors=[grey], names=["previous"], widths=[1.0])
    for state in model.shown_states:
        style(f"/state/{state.name}", band("estimate", palette.estimate))
        dark = rr.SeriesLines(colors=[palette.smoothed] * 3, names=["smoothed", "+2σ", "−2σ"], widths=[1.5, 0.75, 0.75])
        style(f"/smoothed/state/{state.name}", dark)
        style(f"/truth/{state.name}", rr.SeriesLines(colors=[palette.truth], names=["truth"], widths=[1.0]))
        style(f"/previous/state/{state.name}", previous)
    dots = {row for rows in measured_by(model).values() for row in rows}
    for name in model.row_names:
        if model.grid is not None and name not in dots:
            continue
        words = name.replace("_", " ")
        # Points are drawn over lines, so they must let them shine through.
        for kind, color, size, mark in (
            ("reading", (*palette.reading, 70), 1.5, "circle"),
            ("refused", palette.refused, 3.5, "circle"),
            ("screened", palette.refused, 4.0, "cross"),
        ):
            title = words if kind == "reading" else f"{words}, {kind}"
            points = rr.SeriesPoints(colors=[color], names=[title], marker_sizes=[size], markers=[mark])
            style(f"/{kind}/{name}", points)
        if model.grid is None:
            style(f"/innovation/{name}", band("innovation", palette.reading))
    if model.grid is not None:
        field_styles(style, model, palette)
    style("/nis/reading", rr.SeriesPoints(colors=[light], names=["NIS of a reading"], marker_sizes=[1.5]))
    nis = {"names": ["windowed mean", "95 % low", "95 % high"], "widths": [2.0, 1.0, 1.0]}
    style("/nis/window", rr.SeriesLines(colors=[palette.estimate, palette.bound, palette.bound], **nis))
    style("/previous/nis", previous)
    for pair in pairs:
        # Rerun's 2D view has y downwards.
        style(f"/pair/{pair_name(model, pair)}/up", rr.Transform3D(scale=[1.0, -1.0, 1.0]))


def field_pictures(model: StateSpaceModel, root: str, *, truth: bool) -> rrb.Horizontal:
    """Estimate, deviation, and error with the truth behind it in a tab."""
    grid = model.grid
    assert grid is not None
    frame = PictureFrame.of(grid)
    bounds = rrb.VisualBounds2D(
        x_range=(-0.04 * frame.width, (1.2 + 2 * SCALE_GAP) * frame.width),
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


def field_charts(
    model: StateSpaceModel, chart: Callable[..., object], *, truth: bool
) -> list[rrb.View | rrb.Container]:
    """Charts of what all cells, and all rows of each sensor, come to."""
    assert model.grid is not None
    title = "RMSE, spread of all cells" if truth else "spread of all cells"
    found = [chart(f"{title} [{model.grid.unit}]", ["/field/rmse", "/field/spread"])]
    for sensor in model.sensors:
        words = f"{sensor.name.replace('_', ' ')}: " if len(model.sensors) > 1 else ""
        found.append(chart(f"{words}innovations / σ: rms, largest", [f"/innovation/{sensor.name}"]))
    return found


def field_styles(style: Callable[[str, rr.AsComponents], None], model: StateSpaceModel, palette: Palette) -> None:
    """How the lines of a field are drawn."""
    style("/field/rmse", rr.SeriesLines(colors=[palette.truth], names=["RMSE"], widths=[2.0]))
    style("/field/spread", rr.SeriesLines(colors=[palette.estimate], names=["spread"], widths=[2.0]))
    for sensor in model.sensors:
        style(
            f"/innovation/{sensor.name}",
            rr.SeriesLines(colors=[palette.reading, palette.refused], names=["rms", "largest"], widths=[2.0, 1.0]),
        )
