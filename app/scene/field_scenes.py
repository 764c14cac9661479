"""Scenes of a large field: its picture seen from above with the sensors on it, or a surface as high as its estimate."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import viser

from estimators.model.state_space import StateSpaceModel

from ..charts.colors import (
    DEVIATION,
    ESTIMATE,
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
from ..engine.copies import Belief, Pull
from .scene import SQUARE, History, Outlook, Shapes, put_points, segments, set_color, set_text

PICTURE_PERIOD_S = 0.5  # Seconds between two pictures
MAX_TICKS = 12  # Numbers beside the scale
MAX_SURFACE_CORNERS = 48  # Corners of the surface along its longer side

SURFACE_COLORS = 20
"""Colours of the surface; each is a mesh of its own, of which only the triangles change."""

MAX_SURFACE_BARS = 9  # Bars of ± 2 σ along the longer side of the surface
SURFACE_HEIGHT = 0.6  # Height of the highest value above the lowest; the longer side is 2 long


class FieldView:
    """The latest pictures of a field, the kind that is chosen, and its scale; scenes draw them."""

    def __init__(self, api: viser.SceneApi, model: StateSpaceModel, theme: Palette, name: str, *, truth: bool) -> None:
        assert model.grid is not None
        self._unit, self._name = model.grid.unit, name
        self._frame = PictureFrame.of(model.grid)
        self._kinds = {kind.title: kind for kind in kinds(truth)}
        self._kind = ESTIMATE
        self._scales = {kind.name: Scale(kind) for kind in self._kinds.values()}
        self._palettes = {kind.name: gradient(kind.colors) for kind in self._kinds.values()}
        self._latest: dict[str, np.ndarray] = {}
        self._drawn, self._dirty = -np.inf, False
        # The longer side of the picture is 2 long.
        self._size = 2.0 * np.array([self._frame.width, self._frame.height])
        self._size /= max(self._frame.width, self._frame.height)
        self._shapes = Shapes(api)
        self.root = self._shapes.frame()
        self._build(model, theme)

    def _build(self, model: StateSpaceModel, theme: Palette) -> None:
        """Add the shapes."""
        raise NotImplementedError

    def show(self, title: str) -> None:
        """Show the picture of that title."""
        if self._kinds[title] is not self._kind:
            self._kind = self._kinds[title]
            self._drawn, self._dirty = -np.inf, True

    def update(self, pull: Pull) -> None:
        """Keep the latest picture of each kind of a pull."""
        for kind in self._kinds.values():
            images = (image_of(picture, kind) for picture in reversed(pull.pictures))
            found = next((image for image in images if image is not None), None)
            if found is not None:
                self._latest[kind.name] = found
                self._dirty = True

    def _due(self) -> np.ndarray | None:
        """Return the chosen picture (rows, columns) if it has changed and is to be drawn now, and fit its scale."""
        now, image = time.monotonic(), self._latest.get(self._kind.name)
        if not self._dirty or image is None or now - self._drawn < PICTURE_PERIOD_S:
            return None
        self._drawn, self._dirty = now, False
        self._scales[self._kind.name].fit(image)
        return image


class FieldScene(FieldView):
    """Plane seen from above with one picture of the field, its scale, the sensors and the charted cells."""

    def _build(self, model: StateSpaceModel, theme: Palette) -> None:
        frame, size = self._frame, self._size
        places, self._which = positioned(model)
        self._normalised = np.full(len(places), np.nan)
        self._left = -0.5 * size[0] - 0.12  # the scale is to the right
        right = self._left + size[0]
        turn = (0.0, 1.0, 0.0, 0.0)  # Viser's images have their top at -y
        blank = np.full((frame.height, frame.width, 3), 240, np.uint8)
        at = (self._left + 0.5 * size[0], 0.0, 0.0)
        shapes = self._shapes
        # Hidden until its first picture: grey is no temperature.
        hidden = {"format": "png", "wxyz": turn, "visible": False}
        self._image = shapes.body("image", "field", blank, *size, position=at, **hidden)
        at = (right + 0.11, 0.0, 0.0)
        self._bar = shapes.body("image", "scale", blank[:, :1], 0.06, size[1], position=at, **hidden)
        self._labels = [shapes.label(f"ticks/{k}", anchor="center-left", visible=False) for k in range(MAX_TICKS)]
        self._tick_x = right + 0.17
        at = (self._left, 0.5 * size[1] + 0.05, 0.0)
        self._title = shapes.label("title", scale=0.9, position=at, anchor="bottom-left")
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * size + [self._left, -0.5 * size[1]]
        shapes.lines("frame", theme.bound, 1.5, segments(np.column_stack((corners, np.full(5, 0.002)))))
        self._points = None
        if len(places):
            where = self._place(frame.pixels(places), 0.006)
            shapes.dots("sensors/rims", RIM, 0.022, where - np.array([0.0, 0.0, 0.002], np.float32))
            self._points = shapes.dots("sensors/dots", sensor_colors(self._normalised), 0.016, where)
        cells = self._place(frame.pixels(np.array([state.position for state in model.shown_states], float)), 0.01)
        shapes.dots("cells", theme.estimate, 0.03, cells, shape="diamond")
        across, upright = (self._left, right + 0.32), (-0.5 * size[1] - 0.04, 0.5 * size[1] + 0.14)
        self.outlook = Outlook.from_above(np.array([[x, y, 0.0] for x in across for y in upright]))

    def _place(self, pixels: np.ndarray, height: float) -> np.ndarray:
        """Return pixels (k, 2) of the picture as places in the scene (k, 3)."""
        share = pixels / [self._frame.width, self._frame.height]
        x = self._left + share[:, 0] * self._size[0]
        y = (0.5 - share[:, 1]) * self._size[1]
        return np.column_stack((x, y, np.full(len(pixels), height))).astype(np.float32)

    def update(self, pull: Pull) -> None:
        """Keep the latest pictures of a pull, and the latest innovation of each sensor."""
        super().update(pull)
        self._dirty |= take_innovations(self._normalised, self._which, pull.events, pull.track)

    def draw(self, history: History, belief: Belief | None, heavy: bool = True) -> None:
        """Send the chosen picture if it is due."""
        image = self._due()
        if image is None:
            return
        scale, colors = self._scales[self._kind.name], self._palettes[self._kind.name]
        self._image.image = colors[self._frame.enlarge(scale.indices(image))]
        column = np.linspace(254, 0, self._frame.height).round().astype(int)
        self._bar.image = np.repeat(colors[column][:, None], 4, axis=1)
        self._image.visible = self._bar.visible = True
        self._title.text = f"{self._name}: {self._kind.title} [{self._unit}]"
        draw_ticks(self._labels, scale, lambda share: (self._tick_x, (share - 0.5) * self._size[1], 0.0))
        if self._points is not None:
            self._points.colors = sensor_colors(self._normalised)


class FieldSurfaceScene(FieldView):
    """Surface over the plane of x and y, north up, as high as the estimate, in the colours of the chosen picture.

    Bars above and below it reach 2 σ to either side of the estimate.
    """

    def _build(self, model: StateSpaceModel, theme: Palette) -> None:
        frame, half = self._frame, 0.5 * self._size
        sampled = np.linspace(0, 254, SURFACE_COLORS).round().astype(int)
        self._palettes = {name: colors[sampled] for name, colors in self._palettes.items()}
        stride = max(1, -(-max(frame.rows, frame.columns) // MAX_SURFACE_CORNERS))
        self._rows, self._columns = np.arange(0, frame.rows, stride), np.arange(0, frame.columns, stride)
        x = (2.0 * (self._columns + 0.5) / frame.columns - 1.0) * half[0]
        y = (1.0 - 2.0 * (self._rows + 0.5) / frame.rows) * half[1]
        self._x, self._y = (grid.ravel() for grid in np.meshgrid(x, y))
        self._faces = _triangles(len(y), len(x))
        sparse = [np.linspace(0, n - 1, min(n, MAX_SURFACE_BARS)).round().astype(int) for n in (len(y), len(x))]
        self._bars_at = (sparse[0][:, None] * len(x) + sparse[1]).ravel()
        shapes, start = self._shapes, (np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32))
        style = {"color": theme.bound, "visible": False, "side": "double"}
        self._meshes = [shapes.body("mesh_simple", f"bands/{k}", *start, **style) for k in range(SURFACE_COLORS)]
        self._bars = shapes.lines("bars", theme.ink, 1.5)
        low = -0.5 * SURFACE_HEIGHT
        floor = np.column_stack((SQUARE * half, np.full(5, low)))
        upright = np.array([[-half[0], -half[1], low], [-half[0], -half[1], -low]])
        shapes.lines("frame", theme.bound, 1.5, np.concatenate((segments(floor), segments(upright))))
        self._labels = [shapes.label(f"ticks/{k}", anchor="center-right", visible=False) for k in range(MAX_TICKS)]
        at = (-half[0], half[1], 0.15 - low)
        self._title = shapes.label("title", scale=0.9, position=at, anchor="bottom-left")
        x, y = 1.12 * half
        corners = np.array([[a, b, c] for a in (-x, x) for b in (-y, y) for c in (low, SURFACE_HEIGHT)])
        self.outlook = Outlook(corners, np.array([-0.35, -1.0, 0.75]))

    def draw(self, history: History, belief: Belief | None, heavy: bool = True) -> None:
        """Send the surface if it is due."""
        mean = self._latest.get(ESTIMATE.name)
        image = None if mean is None else self._due()
        if mean is None or image is None:
            return
        upright, scale = self._scales[ESTIMATE.name], self._scales[self._kind.name]
        upright.fit(mean)
        pick = np.ix_(self._rows, self._columns)
        values = mean[pick].ravel().astype(float)
        self._paint(np.column_stack((self._x, self._y, self._height(values))), scale.indices(image[pick]).ravel())
        std = self._latest.get(DEVIATION.name)
        if std is not None:
            at, reach = self._bars_at, 2 * std[pick].ravel()[self._bars_at]
            ends = [np.column_stack((self._x[at], self._y[at], self._height(values[at] + s))) for s in (-reach, reach)]
            put_points(self._bars, np.stack(ends, axis=1))
        colors = (
            ""
            if scale is upright
            else f"; colour: {self._kind.title}, {scale.low:.3g} to {scale.high:.3g} {self._unit}"
        )
        self._title.text = f"{self._name} [{self._unit}]{colors}"
        left, front = -0.5 * self._size
        draw_ticks(self._labels, upright, lambda share: (left - 0.03, front, (share - 0.5) * SURFACE_HEIGHT))

    def _height(self, values: np.ndarray) -> np.ndarray:
        scale = self._scales[ESTIMATE.name]
        return ((values - scale.low) / (scale.high - scale.low) - 0.5) * SURFACE_HEIGHT

    def _paint(self, corners: np.ndarray, indices: np.ndarray) -> None:
        """Give each triangle to the mesh of its colour, the mean of its corners'."""
        faces = self._faces[np.isfinite(corners[self._faces]).all(axis=(1, 2))]
        shares = indices[faces].astype(int).mean(axis=1) / 255
        bands = np.minimum(shares * SURFACE_COLORS, SURFACE_COLORS - 1).astype(int)
        for k, (mesh, color) in enumerate(zip(self._meshes, self._palettes[self._kind.name].tolist(), strict=True)):
            mine = faces[bands == k]
            mesh.visible = bool(len(mine))
            if len(mine):
                used, numbers = np.unique(mine, return_inverse=True)
                set_color(mesh, tuple(color))
                mesh.vertices = corners[used].astype(np.float32)
                mesh.faces = numbers.reshape(-1, 3).astype(np.uint32)


def draw_ticks(labels: list[viser.LabelHandle], scale: Scale, place: Callable[[float], tuple]) -> None:
    """Set labels to the numbers of a scale, each at the place of its share of the scale; hide the other labels."""
    ticks = scale.ticks()
    for k, label in enumerate(labels):
        if label.visible != (k < len(ticks)):
            label.visible = k < len(ticks)
        if k < len(ticks):
            share, text = ticks[k]
            label.position = place(share)
            set_text(label, text)


def _triangles(rows: int, columns: int) -> np.ndarray:
    """Return two triangles for each square of a grid of points, (m, 3), numbered row by row."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, below = corner + 1, corner + columns
    return np.concatenate((np.stack((corner, below, right), 1), np.stack((right, below, below + 1), 1)))
