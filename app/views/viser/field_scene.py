"""The scene of a large field: a picture with its scale, and the sensors on it."""

from __future__ import annotations

import time

import numpy as np
import viser

from estimators.log import READING
from estimators.model.state_space import StateSpaceModel

from ...live.outputs import Belief, Pull
from ...present.drawing.geometry import segments
from ...present.drawing.heatmap import ESTIMATE, RIM, Frame, Scale, gradient, image_of, kinds, positioned, sensor_colors
from ...present.drawing.palette import Palette
from .camera import Outlook
from .history import History

EVERY = 0.5
"""Seconds between two pictures at least."""

TICKS = 12
"""Numbers beside the scale at most."""


class FieldScene:
    """A plane seen from above, with one of the field's pictures at a time."""

    def __init__(self, api: viser.SceneApi, model: StateSpaceModel, theme: Palette, *, truth: bool) -> None:
        assert model.grid is not None
        self._unit, self._name = model.grid.unit, model.grid.name.replace("_", " ")
        self._frame = frame = Frame.of(model.grid)
        self._kinds = {kind.title: kind for kind in kinds(truth)}
        self._kind = ESTIMATE
        self._scales = {kind.name: Scale(kind) for kind in self._kinds.values()}
        self._palettes = {kind.name: gradient(kind.colors) for kind in self._kinds.values()}
        self._latest: dict[str, np.ndarray] = {}
        self._drawn = -np.inf
        self._dirty = False
        places, self._which = positioned(model)
        self._normalised = np.full(len(places), np.nan)
        # The picture's longer side is 2 long; the scale stands to its right.
        self._size = 2.0 * np.array([frame.width, frame.height]) / max(frame.width, frame.height)
        self._left = -0.5 * self._size[0] - 0.12
        right = self._left + self._size[0]
        self.root = api.add_frame("/scene", show_axes=False)
        flat = {"cast_shadow": False, "receive_shadow": False}
        # Viser's images have their top at -y.
        turn = (0.0, 1.0, 0.0, 0.0)
        blank = np.full((frame.height, frame.width, 3), 240, np.uint8)
        self._image = api.add_image(
            "/scene/field", blank, *self._size, format="png", wxyz=turn,
            position=(self._left + 0.5 * self._size[0], 0.0, 0.0), **flat,
        )  # fmt: skip
        self._bar = api.add_image(
            "/scene/scale", blank[:, :1], 0.06, self._size[1], format="png", wxyz=turn,
            position=(right + 0.11, 0.0, 0.0), **flat,
        )  # fmt: skip
        self._labels = [
            api.add_label(f"/scene/ticks/{k}", " ", anchor="center-left", font_screen_scale=0.75, visible=False)
            for k in range(TICKS)
        ]
        self._tick_x = right + 0.17
        self._title = api.add_label(
            "/scene/title", " ", position=(self._left, 0.5 * self._size[1] + 0.05, 0.0), anchor="bottom-left",
            font_screen_scale=0.9,
        )  # fmt: skip
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * self._size + [self._left, -0.5 * self._size[1]]
        api.add_line_segments(
            "/scene/frame", segments(np.column_stack((corners, np.full(5, 0.002)))), theme.bound, thickness=1.5,
            thickness_units="screen",
        )  # fmt: skip
        dots = {"point_shape": "circle", "precision": "float32", "point_shading": "flat"}
        self._rims = self._points = None
        if len(places):
            where = self._place(frame.pixels(places), 0.006)
            low = where - [0.0, 0.0, 0.002]
            api.add_point_cloud("/scene/sensors/rims", low, RIM, point_size=0.022, **dots)
            self._points = api.add_point_cloud(
                "/scene/sensors/dots", where, sensor_colors(self._normalised), point_size=0.016, **dots
            )
        cells = np.array([state.position for state in model.shown_states], float)
        api.add_point_cloud(
            "/scene/cells", self._place(frame.pixels(cells), 0.01), theme.estimate, point_size=0.03,
            point_shape="diamond", precision="float32", point_shading="flat",
        )  # fmt: skip
        across, upright = (self._left, right + 0.32), (-0.5 * self._size[1] - 0.04, 0.5 * self._size[1] + 0.14)
        self.outlook = Outlook(
            np.array([[x, y, 0.0] for x in across for y in upright]),
            np.array([0.0, -0.001, 1.0]), np.array([0.0, 1.0, 0.0]), np.radians(9.2),
        )  # fmt: skip

    def _place(self, pixels: np.ndarray, height: float) -> np.ndarray:
        """Pixels (k, 2) of the picture as places in the scene (k, 3)."""
        frame = self._frame
        share = pixels / [frame.width, frame.height]
        x = self._left + share[:, 0] * self._size[0]
        y = (0.5 - share[:, 1]) * self._size[1]
        return np.column_stack((x, y, np.full(len(pixels), height))).astype(np.float32)

    def show(self, title: str) -> None:
        """Show the picture of that title."""
        if self._kinds[title] is not self._kind:
            self._kind = self._kinds[title]
            self._drawn, self._dirty = -np.inf, True

    def take(self, pull: Pull) -> None:
        """Take note of what a pull brings."""
        for kind in self._kinds.values():
            for picture in reversed(pull.pictures):
                image = image_of(picture, kind)
                if image is not None:
                    self._latest[kind.name] = image
                    self._dirty = True
                    break
        events, track = pull.events, pull.track
        for k in np.unique(self._which[:, 0]):
            mine = np.flatnonzero((events.kind == READING) & (events.channel == k))
            if mine.size:
                of = self._which[:, 0] == k
                with np.errstate(invalid="ignore", divide="ignore"):
                    ratio = track.innovation[mine[-1]] / track.innovation_std[mine[-1]]
                self._normalised[of] = ratio[self._which[of, 1]]
                self._dirty = True

    def draw(self, history: History, belief: Belief | None, heavy: bool = True) -> None:
        """Send the picture that is chosen, if it has changed and the last one is old enough."""
        now = time.monotonic()
        kind = self._kind
        image = self._latest.get(kind.name)
        if not self._dirty or image is None or now - self._drawn < EVERY:
            return
        self._drawn, self._dirty = now, False
        scale, colors = self._scales[kind.name], self._palettes[kind.name]
        scale.fit(image)
        self._image.image = colors[self._frame.enlarge(scale.indices(image))]
        column = np.linspace(254, 0, self._frame.height).round().astype(int)
        self._bar.image = np.repeat(colors[column][:, None], 4, axis=1)
        self._title.text = f"{self._name}: {kind.title} [{self._unit}]"
        ticks = scale.ticks()
        for k, label in enumerate(self._labels):
            label.visible = k < len(ticks)
            if k < len(ticks):
                label.position = (self._tick_x, (ticks[k][0] - 0.5) * self._size[1], 0.0)
                label.text = ticks[k][1]
        if self._points is not None:
            self._points.colors = sensor_colors(self._normalised)
