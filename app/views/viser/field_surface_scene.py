"""The scene of a large field as a surface: as high as its estimate, in the colours of the picture that is chosen.

Upright lines over it reach from the estimate 2σ up and down, so that doubt is seen beside the shape.
"""

from __future__ import annotations

import time

import numpy as np
import viser

from estimators.model.state_space import StateSpaceModel

from ...live.outputs import Belief, Pull
from ...present.drawing.geometry import segments
from ...present.drawing.heatmap import DEVIATION, ESTIMATE, Frame, Scale, gradient, image_of, kinds
from ...present.drawing.palette import Palette
from .camera import Outlook
from .history import History

EVERY = 0.5
"""Seconds between two surfaces at least."""

SIDE = 48
"""Corners of the surface along its longer side at most."""

BANDS = 20
"""Colours of the surface: it is a mesh for each, of which only the triangles change."""

DOUBTS = 9
"""Upright lines along the longer side."""

TALL = 0.6
"""From the lowest to the highest colour, where the longer side is 2 long."""

TICKS = 8


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
            for k in range(TICKS)
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
        if not self._dirty or mean is None or image is None or now - self._drawn < EVERY:
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
        for label, tick in zip(self._labels, [*upright.ticks(), *[None] * TICKS], strict=False):
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
