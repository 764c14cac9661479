"""Picture of a twin for the gallery: an SVG with the page's colours, drawn from a fold of the twin's own log.

A field is a map, a vehicle its track among walls, a battery the charge of its cells, three states without a unit a
curve in the plane, 32 states or more an image over time. All others show one state with its band: a parameter that is
estimated, a discrete mode, or a state that no sensor measures.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from app.charts.colors import DEVIATION, ERROR, ESTIMATE, LIGHT, PictureKind, Scale, gradient, image_of
from app.cli.prepare import prepare
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from app.web.gallery.cards import picture_file
from config.loader import find
from config.yaml_files import shown_path, writing
from estimators.diagnostics.field_pictures import Picture
from estimators.log import Events, Log
from estimators.model.state_space import StateSpaceModel
from estimators.track import Track

from .track import TrackSeries, draw_state, hex_color, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT, MARGIN = 320, 140, 8
"""Size of the picture, in points."""

MAX_CARD_GROUPS = 150
MAX_PATH_POINTS = 300
MAX_CLOUD_POINTS = 60
MAX_IMAGE_PIXELS = 150
MIN_IMAGE_STATES = 32
"""States from which on they are drawn as an image over time."""

THEMED = {"estimate": LIGHT.estimate, "truth": LIGHT.truth, "reading": LIGHT.reading, "refused": LIGHT.refused,
          "faint": LIGHT.faint}  # fmt: skip
"""Colours that become those of the page's theme, by the names of its style sheet."""


def draw_card(name: str) -> str:
    """Draw the gallery picture of a twin from its log, and return its path."""
    twin = load_twin(name)
    prepare(twin)
    # A part of an endless or long simulation is enough.
    duration = 10.0 * twin.config.view.window if twin.config.source.type == "simulator" else None
    log, _ = read_log(twin, duration)
    path = picture_file(find(name))
    picture = picture_of(twin, log)
    with writing(path):
        path.parent.mkdir(exist_ok=True)
        path.write_text(picture, encoding="utf-8")
    return shown_path(path)


def picture_of(twin: Any, log: Log) -> str:
    """Return the picture of a twin (`app.twin.twin.Twin`) over a log.

    Raises:
        NisusError: If the fold fails, or Matplotlib is not installed.
    """
    model, scene, window = twin.model, twin.config.view.scene, twin.config.view.window
    fold = twin.fold(log, pairs=twin.pairs, picture=twin.picture)
    cloud = np.zeros((0, model.nx))
    if scene.kind == "vehicle":
        # A quarter into the window the vehicle may still be at several places.
        fold.advance(int(np.searchsorted(log.events.t, log.t[0] + round(0.25e9 * window))))
        if fold.estimator.peaks is not None:
            points = np.asarray(fold.points())
            cloud = points[:: max(1, len(points) // MAX_CLOUD_POINTS)]
    fold.advance()
    events, track = log.events, fold.track
    first = slice(0, int(np.searchsorted(events.t, events.t[0] + round(1e9 * window))))
    figure = new_figure(WIDTH / 72, HEIGHT / 72)
    axes = figure.add_axes((MARGIN / WIDTH, MARGIN / HEIGHT, 1 - 2 * MARGIN / WIDTH, 1 - 2 * MARGIN / HEIGHT))
    axes.set_axis_off()
    axes.margins(0.0)
    names = scene.axes or model.state_names[:3]
    units = {model.states[model.state_names.index(name)].unit for name in names}
    if model.grid is not None:
        _draw_maps(axes, fold.pictures.taken if fold.pictures is not None else [])
    elif scene.kind == "vehicle":
        path = _path_of(model, scene.position, events, track)
        if not scene.walls and _is_straight(path[0]):
            _draw_states(axes, TrackSeries(model, events, track, MAX_CARD_GROUPS), None)
        else:
            east, north = (model.state_names.index(name) for name in scene.position)
            _draw_path(axes, *path, cloud[:, [east, north]], [np.array(wall, float) for wall in scene.walls])
    elif scene.kind == "battery":
        _draw_states(axes, TrackSeries(model, events, track, MAX_CARD_GROUPS), scene.charge)
    elif len(model.shown) >= MIN_IMAGE_STATES:
        axes.set_position((0.0, 0.0, 1.0, 1.0))
        _draw_image(axes, track.mean[first].T, ESTIMATE, (0.0, 1.0, 0.0, 1.0))
        axes.set_aspect("auto")
    elif len(names) == 3 and units <= {"", "1"}:
        series = TrackSeries(model, events.select(first), track.select(first))
        for kind, color, width in (("mean", LIGHT.estimate, 1.6), ("truth", LIGHT.truth, 1.1)):
            _draw_line(axes, np.stack([series.raw(f"{kind}:{name}") for name in (names[0], names[2])]), color, width)
    else:
        sought = next((name for name, item in twin.config.parameters.items() if item.role == "estimated"), None)
        series = TrackSeries(model, events, track, MAX_CARD_GROUPS)
        _draw_states(axes, series, [sought or _least_measured(series)])
    return _themed_svg(figure)


def _least_measured(series: TrackSeries) -> str:
    """Return the discrete mode, or the first state that no sensor measures, or the first."""
    model, names = series.model, [state.name for state in series.model.shown_states]
    if model.mode is not None and model.mode >= 0:
        return names[model.mode]
    return next((name for name in names if name not in series.measured_by), names[0])


def _most_rejected(series: TrackSeries) -> str:
    """Return the state whose measurements the gate rejected most often."""

    def rejected(state: str) -> int:
        rows = series.measured_by[state]
        return max(int(np.isfinite(series.raw(f"refused:{row}")).sum()) for row in rows)

    return max(series.measured_by, key=rejected, default="") or _least_measured(series)


def _draw_states(axes: Axes, series: TrackSeries, names: Sequence[str] | None) -> None:
    """Draw states over time; of several the least certain with its band. None is the most rejected one."""
    names = [_most_rejected(series)] if names is None else names
    width = {name: float(np.nanmean(series.raw(f"upper:{name}") - series.raw(f"lower:{name}"))) for name in names}
    main = max(names, key=lambda name: width[name])
    for name in names:
        if name != main:
            seconds, values = series[f"mean:{name}"]
            axes.plot(seconds, values, color=hex_color(LIGHT.estimate), lw=1.3, clip_on=False)
    draw_state(axes, series, main)
    lines = [values for name in names for values in (series[f"mean:{name}"][1], series[f"truth:{name}"][1])]
    # At the start the prior may be far off, and its band far wider than the rest.
    bands = [series[f"{kind}:{main}"][1] for kind in ("upper", "lower")]
    shown = np.concatenate([part[len(part) // 30 :] for part in lines] + [part[len(part) // 10 :] for part in bands])
    axes.set_ylim(float(np.nanmin(shown)), float(np.nanmax(shown)) + 1e-12)
    axes.set_xlim(0.0, series.events.seconds)


def _path_of(
    model: StateSpaceModel, position: tuple[str, str], events: Events, track: Track
) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimated and the true path, both (2, points), NaN where the position is not yet known."""
    series = TrackSeries(model, events, track)
    mean, truth = (np.stack([series.raw(f"{kind}:{name}") for name in position]) for kind in ("mean", "truth"))
    width = sum(series.raw(f"upper:{name}") - series.raw(f"lower:{name}") for name in position)
    mean[:, ~(width < 4.0 * np.nanmedian(width) + 1e-9)] = np.nan
    rows = np.unique(np.linspace(0, len(events) - 1, MAX_PATH_POINTS).astype(int))
    known = truth[:, np.isfinite(truth).all(axis=0)]
    return mean[:, rows], known[:, :: max(1, known.shape[1] // MAX_PATH_POINTS)]


def _is_straight(path: np.ndarray) -> bool:
    """Return whether a path is a line, of which a map would show nothing."""
    spread = np.linalg.eigvalsh(np.cov(path[:, np.isfinite(path).all(axis=0)]))
    return bool(spread[0] < 1e-3 * spread[1])


def _draw_path(axes: Axes, mean: np.ndarray, truth: np.ndarray, cloud: np.ndarray, walls: Sequence[np.ndarray]) -> None:
    """Draw where a vehicle went, with walls and particles; north is up if there are walls."""
    if not walls:
        turn = _long_side_across(mean)
        mean, truth, cloud = turn @ mean, turn @ truth, cloud @ turn.T
    for wall in walls:
        _draw_line(axes, wall.T, LIGHT.faint, 1.4)
    axes.plot(*cloud.T, ls="", marker="o", ms=3.0, mew=0, alpha=0.35, color=hex_color(LIGHT.estimate), clip_on=False)
    _draw_line(axes, truth, LIGHT.truth, 1.1)
    _draw_line(axes, mean, LIGHT.estimate, 1.6)
    axes.set_aspect("equal")


def _long_side_across(path: np.ndarray) -> np.ndarray:
    """Return the rotation (2, 2) after which the longest axis of a path lies across."""
    axis = np.linalg.eigh(np.cov(path[:, np.isfinite(path).all(axis=0)]))[1][:, -1]
    x, y = axis * (np.sign(axis[0]) or 1.0)
    return np.array([[x, y], [-y, x]])


def _draw_line(axes: Axes, points: np.ndarray, color: tuple[int, int, int], width: float) -> None:
    if np.isfinite(points).all(axis=0).any():
        dashes = (0, (4, 3)) if color is LIGHT.truth else "-"
        axes.plot(*points, color=hex_color(color), lw=width, ls=dashes, clip_on=False)


def _draw_maps(axes: Axes, pictures: Sequence[Picture]) -> None:
    """Draw the last picture of a field, and beside it the error, or the standard deviation if no truth is known."""
    kept = [picture for picture in pictures if picture.mean is not None]
    if not kept:
        return
    last = next((picture for picture in reversed(kept) if picture.truth is not None), kept[-1])
    for k, kind in enumerate((ESTIMATE, ERROR if last.truth is not None else DEVIATION)):
        image = image_of(last, kind)
        if image is not None:
            ratio = image.shape[1] / image.shape[0]
            _draw_image(axes, image, kind, (k * 1.06 * ratio, k * 1.06 * ratio + ratio, 0.0, 1.0))
    axes.autoscale_view()
    axes.set_aspect("equal")


def _draw_image(axes: Axes, values: np.ndarray, kind: PictureKind, extent: tuple[float, float, float, float]) -> None:
    step = -(-np.array(values.shape) // MAX_IMAGE_PIXELS)
    values = values[:: step[0], :: step[1]]
    scale = Scale(kind)
    scale.fit(values)
    colors = gradient(kind.colors)[scale.indices(values)]
    axes.imshow(colors, extent=extent, interpolation="none", aspect="auto", clip_on=False)
    axes.set_xlim(0.0, max(extent[1], axes.get_xlim()[1]))


def _themed_svg(figure: Figure) -> str:
    """Return a figure as an SVG for the page: colours by name, nothing that is fetched."""
    import matplotlib

    file = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "nisus", "path.simplify": True}):
        empty = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(file, format="svg", transparent=True, metadata=empty)
    text = file.getvalue()
    text = text[text.index("<svg") :].replace("<svg ", '<svg class="card-picture" ', 1)
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"-?\d+\.\d{3,}", lambda number: f"{float(number[0]):.2f}", text)
    for name, color in THEMED.items():
        text = text.replace(hex_color(color), f"var(--{name},{hex_color(color)})")
    return text
