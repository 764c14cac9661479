"""A large field in Rerun: pictures with a scale, the sensors on them, and what the errors of all cells come to."""

from __future__ import annotations

import numpy as np
import rerun as rr

from estimators.diagnostics.field_pictures import Picture
from estimators.log import READING, Events
from estimators.model.state_space import StateSpaceModel
from estimators.track import Track

from ...present.drawing.heatmap import RIM, Frame, Scale, gradient, image_of, kinds, positioned, sensor_colors
from ...present.drawing.palette import EITHER, Palette
from .sink import Sink
from .style import GAP


class FieldDrawing:
    """Logs the pictures of a field below /field, and one line for all innovations of a sensor."""

    def __init__(self, model: StateSpaceModel, *, truth: bool, theme: Palette = EITHER) -> None:
        self._theme = theme
        assert model.grid is not None
        self._model = model
        self._frame = Frame.of(model.grid)
        self._bar = max(3, round(GAP * self._frame.width))
        self._kinds = kinds(truth)
        self._palettes = {kind.name: gradient(kind.colors) for kind in self._kinds}
        self._scales = {kind.name: Scale(kind) for kind in self._kinds}
        places, self._which = positioned(model)
        self._dots = self._frame.pixels(places) if len(places) else np.zeros((0, 2))
        cells = np.array([state.position for state in model.shown_states], float)
        self._probes = self._frame.pixels(cells)
        self._normalised = np.full(len(places), np.nan)

    def static(self, sink: Sink) -> None:
        """Log what stays: the scale's place, the sensors' rims, the charted cells with their names."""
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
        """Log of each sensor with many rows the size of its innovations, in units of their deviations."""
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
        """Remember the newest innovation of each sensor row, for the dots on the pictures."""
        for k in range(len(self._model.sensors)):
            mine = np.flatnonzero((events.kind == READING) & (events.channel == k))
            if mine.size:
                last = mine[-1]
                of = self._which[:, 0] == k
                with np.errstate(invalid="ignore", divide="ignore"):
                    ratio = track.innovation[last] / track.innovation_std[last]
                self._normalised[of] = ratio[self._which[of, 1]]

    def pictures(self, sink: Sink, pictures: list[Picture], *, current: bool) -> None:
        """Log pictures; the sensors' colours with the last one, if it is the newest."""
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
