"""The scene of a large field as a surface: as high as its estimate, in the colours of the picture that is chosen.

Upright lines over it reach from the estimate 2σ up and down, so that doubt is seen beside the shape.
"""

from __future__ import annotations

import time

import numpy as np
import viser

from estimators.log import READING
from estimators.model.state_space import StateSpaceModel

from ...live.outputs import Belief, Pull
from ...present.drawing.colors import (
    DEVIATION,
    ESTIMATE,
    RIM,
    Frame,
    Palette,
    Scale,
    gradient,
    image_of,
    kinds,
    positioned,
    sensor_colors,
)
from .scene import History, Outlook, segments

SIDE = 48
"""Corners of the surface along its longer side at most."""

BANDS = 20
"""Colours of the surface: it is a mesh for each, of which only the triangles change."""

DOUBTS = 9
"""Upright lines along the longer side."""

TALL = 0.6
"""From the lowest to the highest colour, where the longer side is 2 long."""

MAX_HEIGHT_TICKS = 8


class FieldSurfaceScene:
    """The field lies in the plane of x and y, north up; its values are upright."""

    def __init__(self, api: viser.SceneApi, model: StateSpaceModel, theme: Palette, *, truth: bool) -> None:
        assert model.grid is not None
        self._unit, self._name = model.grid.unit, model.grid.name.replace("_", " ")
        frame = Frame.of(model.grid)
        self._kinds = {kind.title: kind for kind in kinds(truth)}
        self._kind = ESTIMATE
        self._scales = {kind.name: Scale(kind) for kind in self._kinds.values()}
        self._latest: dict[str, np.ndarray] = {}
        self._drawn, self._dirty = -np.inf, False
        self._palettes = {
            kind.name: gradient(kind.colors)[np.linspace(0, 254, BANDS).round().astype(int)]
            for kind in self._kinds.values()
        }
        stride = max(1, -(-max(frame.rows, frame.columns) // SIDE))
        self._rows, self._columns = np.arange(0, frame.rows, stride), np.arange(0, frame.columns, stride)
        across, down = 2.0 * np.array([frame.width, frame.height]) / max(frame.width, frame.height)
        x = ((self._columns + 0.5) / frame.columns - 0.5) * across
        y = (0.5 - (self._rows + 0.5) / frame.rows) * down
        self._x, self._y = (grid.ravel() for grid in np.meshgrid(x, y))
        self._faces = _triangles(len(y), len(x))
        sparse = [np.linspace(0, n - 1, min(n, DOUBTS)).round().astype(int) for n in (len(y), len(x))]
        self._posts = (sparse[0][:, None] * len(x) + sparse[1]).ravel()
        self.root = api.add_frame("/scene", show_axes=False)
        flat = {"cast_shadow": False, "receive_shadow": False, "side": "double"}
        start = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
        self._meshes = [
            api.add_mesh_simple(f"/scene/bands/{k}", *start, color=theme.bound, visible=False, **flat)
            for k in range(BANDS)
        ]
        nothing = np.zeros((1, 2, 3), np.float32)
        self._doubts = api.add_line_segments(
            "/scene/doubts", nothing, theme.ink, thickness=1.5, thickness_units="screen"
        )
        half = np.array([0.5 * across, 0.5 * down])
        self._left = float(-half[0])
        floor = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half
        low = -0.5 * TALL
        edge = [[-half[0], -half[1], low], [-half[0], -half[1], -low]]
        self._front = float(-half[1])
        frame_lines = np.concatenate((segments(np.column_stack((floor, np.full(5, low)))), segments(np.array(edge))))
        api.add_line_segments("/scene/frame", frame_lines, theme.bound, thickness=1.5, thickness_units="screen")
        self._labels = [
            api.add_label(f"/scene/ticks/{k}", " ", anchor="center-right", font_screen_scale=0.75, visible=False)
            for k in range(MAX_HEIGHT_TICKS)
        ]
        self._title = api.add_label(
            "/scene/title", " ", position=(-half[0], half[1], 0.5 * TALL + 0.15), anchor="bottom-left",
            font_screen_scale=0.9,
        )  # fmt: skip
        wide = 1.12 * half
        corners = np.array([[a * wide[0], b * wide[1], c] for a in (-1, 1) for b in (-1, 1) for c in (low, TALL)])
        self.outlook = Outlook(corners, np.array([-0.35, -1.0, 0.75]), np.array([0.0, 0.0, 1.0]), float(np.radians(20)))

    def show(self, title: str) -> None:
        """Colour the surface by the picture of that title."""
        if self._kinds[title] is not self._kind:
            self._kind = self._kinds[title]
            self._drawn, self._dirty = -np.inf, True

    def take(self, pull: Pull) -> None:
        """Take note of what a pull brings."""
        for kind in self._kinds.values():
            images = (image_of(picture, kind) for picture in reversed(pull.pictures))
            found = next((image for image in images if image is not None), None)
            if found is not None:
                self._latest[kind.name] = found
                self._dirty = True

    def draw(self, history: History, belief: Belief | None, heavy: bool = True) -> None:
        """Send the surface, if it has changed and the last one is old enough."""
        now = time.monotonic()
        mean, image = self._latest.get(ESTIMATE.name), self._latest.get(self._kind.name)
        if not self._dirty or mean is None or image is None or now - self._drawn < PICTURE_PERIOD_S:
            return
        self._drawn, self._dirty = now, False
        upright, scale = self._scales[ESTIMATE.name], self._scales[self._kind.name]
        upright.fit(mean)
        scale.fit(image)
        pick = np.ix_(self._rows, self._columns)
        values = mean[pick].ravel().astype(float)
        height = self._height(values)
        self._paint(np.column_stack((self._x, self._y, height)), scale.indices(image[pick]).ravel())
        std = self._latest.get(DEVIATION.name)
        if std is not None:
            spread = 2 * std[pick].ravel()[self._posts]
            ends = [np.column_stack((self._x[self._posts], self._y[self._posts], self._height(values[self._posts] + s)))
                    for s in (-spread, spread)]  # fmt: skip
            lines = np.stack(ends, axis=1)
            self._doubts.points = lines[np.isfinite(lines).all(axis=(1, 2))].astype(np.float32)
        self._title.text = f"{self._name} [{self._unit}]; colour: {self._kind.title}"
        for label, tick in zip(self._labels, [*upright.ticks(), *[None] * MAX_HEIGHT_TICKS], strict=False):
            label.visible = tick is not None
            if tick is not None:
                label.position = (self._left - 0.03, self._front, (tick[0] - 0.5) * TALL)
                label.text = tick[1]

    def _height(self, values: np.ndarray) -> np.ndarray:
        scale = self._scales[ESTIMATE.name]
        return ((values - scale.low) / (scale.high - scale.low) - 0.5) * TALL

    def _paint(self, corners: np.ndarray, indices: np.ndarray) -> None:
        """Give each triangle to the mesh of its colour: that of the mean of its corners."""
        faces = self._faces[np.isfinite(corners[self._faces]).all(axis=(1, 2))]
        bands = np.minimum(indices[faces].astype(int).mean(axis=1) * BANDS / 255, BANDS - 1).astype(int)
        colors = self._palettes[self._kind.name]
        for k, mesh in enumerate(self._meshes):
            mine = faces[bands == k]
            mesh.visible = bool(len(mine))
            if not len(mine):
                continue
            used, numbers = np.unique(mine, return_inverse=True)
            red, green, blue = (int(part) for part in colors[k])
            if tuple(mesh.color) != (red, green, blue):
                mesh.color = (red, green, blue)
            mesh.vertices = corners[used].astype(np.float32)
            mesh.faces = numbers.reshape(-1, 3).astype(np.uint32)


def _triangles(rows: int, columns: int) -> np.ndarray:
    """Two triangles for each square of a grid of points, (m, 3), numbered row by row."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, below = corner + 1, corner + columns
    return np.concatenate((np.stack((corner, below, right), 1), np.stack((right, below, below + 1), 1)))


PICTURE_PERIOD_S = 0.5
"""Seconds between two pictures at least."""

MAX_SCALE_TICKS = 12
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
            for k in range(MAX_SCALE_TICKS)
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
        if not self._dirty or image is None or now - self._drawn < PICTURE_PERIOD_S:
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
