"""Pictures in Rerun: a large field with its sensors and scale; two states with 2σ ellipse, trail and truth."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import rerun as rr

from estimators.diagnostics.field_pictures import Picture
from estimators.log import READING, RESET, Events, truth_of
from estimators.model.state_space import StateSpaceModel
from estimators.track import Track

from ..charts.colors import (
    EITHER,
    RIM,
    Palette,
    PictureFrame,
    Scale,
    gradient,
    image_of,
    kinds,
    positioned,
    sensor_colors,
    take_innovations,
)
from .sink import SCALE_GAP, Sink, last_of_stretch


class FieldDrawing:
    """Logs the pictures of a field below /field, and one line for all innovations of a sensor."""

    def __init__(self, model: StateSpaceModel, *, truth: bool, theme: Palette = EITHER) -> None:
        self._theme = theme
        assert model.grid is not None
        self._model = model
        self._frame = PictureFrame.of(model.grid)
        self._bar = max(3, round(SCALE_GAP * self._frame.width))
        self._kinds = kinds(truth)
        self._palettes = {kind.name: gradient(kind.colors) for kind in self._kinds}
        self._scales = {kind.name: Scale(kind) for kind in self._kinds}
        places, self._which = positioned(model)
        self._dots = self._frame.pixels(places) if len(places) else np.zeros((0, 2))
        cells = np.array([state.position for state in model.shown_states], float)
        self._probes = self._frame.pixels(cells)
        self._normalised = np.full(len(places), np.nan)

    def static(self, sink: Sink) -> None:
        """Log static parts: scale, rims of the sensors, charted cells with their names."""
        bar = np.linspace(254, 0, self._frame.height).round().astype(np.uint8)[:, None].repeat(self._bar, axis=1)
        names = [state.name.removeprefix(f"{self._model.grid.name}") for state in self._model.shown_states]  # type: ignore[union-attr]
        for kind in self._kinds:
            beside = rr.Transform3D(translation=[self._frame.width + self._bar, 0.0, 0.0])
            sink.static(f"/field/{kind.name}/bar", beside)
            colors = self._palettes[kind.name]
            sink.static(f"/field/{kind.name}/bar", rr.Image(colors[bar], opacity=1.0))
            # A picture is one byte a pixel, and the colours belong to it. (An encoded image would be drawn faded
            # until it is decoded, at every change.)
            sink.static(
                f"/field/{kind.name}",
                rr.AnnotationContext([rr.AnnotationInfo(id=k, color=color) for k, color in enumerate(colors.tolist())]),
            )
            size = rr.components.ImageFormat(
                width=self._frame.width, height=self._frame.height, channel_datatype=rr.ChannelDatatype.U8
            )
            sink.static(f"/field/{kind.name}/image", rr.SegmentationImage.from_fields(format=size, opacity=1.0))
            if len(self._dots):
                rims = rr.Points2D(self._dots, radii=-3.0, colors=[RIM], draw_order=20.0)
                sink.static(f"/field/{kind.name}/rims", rims)
                sink.static(f"/field/{kind.name}/sensors", rr.Points2D.from_fields(draw_order=30.0))
            sink.static(
                f"/field/{kind.name}/cells",
                rr.Points2D(
                    self._probes,
                    radii=-3.0,
                    colors=[self._theme.estimate],
                    labels=names,
                    show_labels=False,
                    draw_order=40.0,
                ),
            )

    def readings(self, sink: Sink, events: Events, track: Track, width: int) -> None:
        """Log the size of each sensor's innovations (rms and largest), in units of their deviations."""
        is_reading = events.kind == READING
        for k, sensor in enumerate(self._model.sensors):
            mask = is_reading & (events.channel == k)
            if not mask.any():
                continue
            count = len(sensor.rows)
            with np.errstate(invalid="ignore", divide="ignore"):
                sizes = np.abs(track.innovation[mask, :count] / track.innovation_std[mask, :count])
            known = np.isfinite(sizes)
            number = np.maximum(known.sum(axis=1), 1)
            rms = np.sqrt(np.where(known, sizes, 0.0).__pow__(2).sum(axis=1) / number)
            values = np.stack((rms, np.where(known, sizes, 0.0).max(axis=1)), axis=1)
            values[~known.any(axis=1)] = np.nan
            sink.line(f"/innovation/{sensor.name}", events.t[mask], values, width, by_first=True)

    def note(self, events: Events, track: Track) -> None:
        """Keep the latest innovation of each sensor row, for the dots on the pictures."""
        take_innovations(self._normalised, self._which, events, track)

    def pictures(self, sink: Sink, pictures: list[Picture], *, current: bool) -> None:
        """Log pictures, and with the newest one the colours of the sensors."""
        if not pictures:
            return
        t = np.array([picture.t for picture in pictures], np.int64)
        spread = np.array([picture.spread for picture in pictures])
        rmse = np.array([picture.rmse for picture in pictures])
        sink.line("/field/spread", t, spread[:, None], 0, by_first=True, gaps=True)
        sink.line("/field/rmse", t, rmse[:, None], 0, by_first=True)
        for picture in pictures:
            for kind in self._kinds:
                image = image_of(picture, kind)
                if image is not None:
                    self._draw(sink, picture.t, kind.name, image)
        if current:
            self._sensors(sink, int(t[-1]))

    def _draw(self, sink: Sink, t: int, name: str, image: np.ndarray) -> None:
        scale, frame = self._scales[name], self._frame
        scale.fit(image)
        canvas = frame.enlarge(scale.indices(image))
        at = np.array([t])
        sink.columns(f"/field/{name}/image", at, rr.SegmentationImage.columns(buffer=[canvas.tobytes()]))
        ticks = scale.ticks()
        # A label stands below its point, in its middle.
        across, above = frame.width + 2.0 * self._bar + 0.09 * frame.width, 0.035 * frame.height
        positions = np.array([[across, (1.0 - place) * frame.height - above] for place, _ in ticks]).reshape(-1, 2)
        labels = rr.Points2D.columns(
            positions=positions.astype(np.float32), labels=[text for _, text in ticks],
            colors=[(120, 120, 128)] * len(ticks), radii=np.full(len(ticks), -0.1, np.float32),
        )  # fmt: skip
        sink.columns(f"/field/{name}/scale", at, labels.partition([len(ticks)]))

    def _sensors(self, sink: Sink, t: int) -> None:
        count = len(self._dots)
        if not count:
            return
        for kind in self._kinds:
            dots = rr.Points2D.columns(
                positions=self._dots.astype(np.float32), colors=sensor_colors(self._normalised),
                radii=np.full(count, -2.0, np.float32),
            )  # fmt: skip
            sink.columns(f"/field/{kind.name}/sensors", np.array([t]), dots.partition([count]))


ELLIPSE_POINTS = 65  # Points of an ellipse, the first one again at the end
TRAIL_POINTS = 100  # Points of the trail behind the mean

WINDOW_ELLIPSES = 400
"""Ellipses in one window of the charts, or in a longer history that is drawn at once."""

PICTURE_RATIO = 2.5  # Approximate width of the picture over its height

LABEL_HALF_WIDTH, LABEL_HEIGHT = 0.2, 0.4
"""Shares of the picture's width and height that the labels take, beside and below their point."""

_STRIP = rr.components.LineStrip2DBatch._ARROW_DATATYPE
_POINT = _STRIP.value_type
_angle = np.linspace(0.0, 2.0 * np.pi, ELLIPSE_POINTS)
_circle = np.stack((np.cos(_angle), np.sin(_angle)), axis=1)


def ellipse_points(mean: np.ndarray, var: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """Lines of 2σ ellipses.

    m + 2 L (cos φ, sin φ),   L Lᵀ = P

    Args:
        mean: Shape (n, 2).
        var: Diagonals of P, shape (n, 2).
        cross: Off-diagonal entries, shape (n,).

    Returns:
        Shape (n, ELLIPSE_POINTS, 2).
    """
    l11 = np.sqrt(var[:, 0])
    l21 = np.divide(cross, l11, out=np.zeros_like(cross), where=l11 > 0)
    l22 = np.sqrt(np.maximum(var[:, 1] - l21**2, 0.0))
    x = l11[:, None] * _circle[:, 0]
    y = l21[:, None] * _circle[:, 0] + l22[:, None] * _circle[:, 1]
    return mean[:, None, :] + 2.0 * np.stack((x, y), axis=2)


def anchors(mean: np.ndarray, ellipses: np.ndarray, ways: list[np.ndarray]) -> np.ndarray:
    """Return the positions of the labels, (n, 2): the mean, but so far from the edge that no view cuts them off.

    `mean` is (n, 2), `ellipses` (n, ELLIPSE_POINTS, 2), and `ways` are n lines of shape (k, 2).
    """
    low = np.stack([np.minimum(e.min(0), way.min(0)) for e, way in zip(ellipses, ways, strict=True)])
    high = np.stack([np.maximum(e.max(0), way.max(0)) for e, way in zip(ellipses, ways, strict=True)])
    middle, size = 0.5 * (low + high), high - low
    # The view has one scale for both axes: the longer one fills it.
    height = np.maximum(size[:, 1], size[:, 0] / PICTURE_RATIO)
    edge = np.stack(((0.5 - LABEL_HALF_WIDTH) * PICTURE_RATIO * height, (0.5 - LABEL_HEIGHT) * height), axis=1)
    x = np.clip(mean[:, 0], middle[:, 0] - edge[:, 0], middle[:, 0] + edge[:, 0])
    return np.stack((x, np.maximum(mean[:, 1], middle[:, 1] - edge[:, 1])), axis=1)


def strips(lines: list[np.ndarray]) -> pa.Array:
    """Return lines of shape (k, 2) each in Rerun's Arrow type; its own conversion takes 50 µs a line."""
    ends = np.cumsum([0] + [line.shape[0] for line in lines]).astype(np.int32)
    points = pa.FixedSizeListArray.from_arrays(pa.array(np.concatenate(lines).reshape(-1)), type=_POINT)
    return pa.ListArray.from_arrays(pa.array(ends), points, type=_STRIP)


def _lines(lines: list[np.ndarray], color: tuple[int, int, int], width: float) -> rr.ComponentColumnList:
    # A negative radius is in pixels.
    radii = np.full(len(lines), -width, np.float32)
    return rr.LineStrips2D.columns(strips=strips(lines), colors=[color] * len(lines), radii=radii)


def _dots(places: np.ndarray, color: tuple[int, int, int], radius: float, **more: object) -> rr.ComponentColumnList:
    radii = np.full(len(places), radius, np.float32)
    return rr.Points2D.columns(positions=places.astype(np.float32), colors=[color] * len(places), radii=radii, **more)


def axis_scales(model: StateSpaceModel, pair: np.ndarray) -> np.ndarray:
    """Return the scale of each axis: 1 if the units agree, or the order of magnitude of the priors' deviations.

    Rerun's view has one scale for both axes, in which a temperature would hide its rate.
    """
    a, b = (model.states[j] for j in pair)
    if a.unit == b.unit:
        return np.ones(2)
    widths = np.array([a.std or 1.0, b.std or 1.0])
    return 10.0 ** np.round(np.log10(widths))


class PairDrawing:
    """Draws one pair of states below one path."""

    def __init__(
        self, model: StateSpaceModel, index: int, pair: np.ndarray, path: str, palette: Palette = EITHER
    ) -> None:
        self._palette = palette
        self._model = model
        self._index = index
        self._pair = pair
        self._path = path
        self._scale = axis_scales(model, pair)
        # Of a large field the track keeps some cells.
        self._columns = np.searchsorted(model.shown, pair, sorter=np.argsort(model.shown))
        self._columns = np.argsort(model.shown)[self._columns]
        self._last: int | None = None
        self._way = np.zeros((0, 2), np.float32)
        self._way_t = np.zeros(0, np.int64)

    def draw(self, sink: Sink, t: np.ndarray, track: Track, events: Events, past: bool) -> None:
        """Log the pictures of some rows of the track."""
        step = int(max(sink.window * 1e9, int(t[-1]) - int(t[0])) / WINDOW_ELLIPSES)
        pick = last_of_stretch(t, step)
        if past or self._last is None:
            self._last = None
        else:
            # After a reset there may be no other row.
            pick = pick[(t[pick] >= self._last + step // 2) | (events.kind[pick] == RESET)]
        if not pick.size:
            return
        columns = (
            track.mean[pick][:, self._columns],
            track.std[pick][:, self._columns],
            track.cross[pick, self._index],
        )
        known = np.isfinite(np.column_stack(columns)).all(axis=1)
        for run in np.split(pick, np.flatnonzero(known[1:] != known[:-1]) + 1):
            if known[np.searchsorted(pick, run[0])]:
                self._pictures(sink, t[run], track.select(run), past)
            else:
                self._blank(sink, t[run[:1]], past)
        if not past:
            self._last = int(t[pick[-1]])
        self._truth(sink, events, t[pick])

    def _blank(self, sink: Sink, t: np.ndarray, past: bool) -> None:
        """Clear the picture from a time (1,) on, at which the estimate is not a number."""
        for name in ("ellipse", "mean", "numbers", "way"):
            sink.gap(f"{self._path}/{name}", t)
        if not past:
            self._way, self._way_t = self._way[:0], self._way_t[:0]

    def _pictures(self, sink: Sink, t: np.ndarray, track: Track, past: bool) -> None:
        mean = track.mean[:, self._columns] / self._scale
        var = (track.std[:, self._columns] / self._scale) ** 2
        cross = track.cross[:, self._index] / self._scale.prod()
        points = ellipse_points(mean, var, cross).astype(np.float32)
        color, way = self._palette.estimate, self._trail(sink, t, mean.astype(np.float32), past)
        self._each(sink, "ellipse", t, _lines(list(points), color, 1.0))
        self._each(sink, "mean", t, _dots(mean, color, -3.0))
        self._each(sink, "numbers", t, _dots(anchors(mean, points, way), color, -0.01, labels=self._labels(track)))
        self._each(sink, "way", t, _lines(way, self._palette.previous, 0.5))

    def _each(self, sink: Sink, name: str, t: np.ndarray, what: rr.ComponentColumnList) -> None:
        """Log one picture for each time."""
        sink.columns(f"{self._path}/{name}", t, what.partition(np.full(t.size, 1)))

    def _labels(self, track: Track) -> list[str]:
        units = [self._model.states[j].unit.replace("1", "") for j in self._pair]
        means, stds = track.mean[:, self._columns], track.std[:, self._columns]
        return [
            f"{m[0]:.4g} ± {s[0]:.2g} {units[0]}\n{m[1]:.4g} ± {s[1]:.2g} {units[1]}"
            for m, s in zip(means, stds, strict=True)
        ]

    def _trail(self, sink: Sink, t: np.ndarray, mean: np.ndarray, past: bool) -> list[np.ndarray]:
        """Return for each row the trail that leads to it, within the window of the charts."""
        before, before_t = (self._way[:0], self._way_t[:0]) if past else (self._way, self._way_t)
        keep = last_of_stretch(t, int(sink.window * 1e9 / TRAIL_POINTS))
        way = np.concatenate((before, mean[keep]))
        way_t = np.concatenate((before_t, t[keep]))
        start = np.searchsorted(way_t, t - int(sink.window * 1e9))
        end = np.searchsorted(way_t, t)
        if not past:
            recent = way_t >= t[-1] - int(sink.window * 1e9)
            self._way, self._way_t = way[recent], way_t[recent]
        # A strip needs two points, also at the first row.
        return [
            np.concatenate((way[max(i, j - 2 * TRAIL_POINTS) : j], here[None], here[None]))
            for i, j, here in zip(start, end, mean, strict=True)
        ]

    def _truth(self, sink: Sink, events: Events, wanted: np.ndarray) -> None:
        (in_a, a), (in_b, b) = (truth_of(events, int(j)) for j in self._pair)
        times, of_a, of_b = np.intersect1d(events.t[in_a], events.t[in_b], return_indices=True)
        if not times.size:
            return
        near = np.unique(np.clip(np.searchsorted(times, wanted), 0, times.size - 1))
        values = np.stack((a[of_a], b[of_b]), axis=1)[near] / self._scale
        self._each(sink, "truth", times[near], _dots(values, self._palette.truth, -4.0))
