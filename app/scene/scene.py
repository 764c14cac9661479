"""Parts that all scenes share: the recent rows of the track, cameras, and shapes such as ellipsoids and polylines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import viser

from estimators.log import Events

from ..charts.colors import RGB
from ..engine.copies import Pull

SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], float)
"""Outline of the square from -1 to 1."""


def ellipsoid(cov: np.ndarray, sigmas: float = 2.0) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Return the ellipsoid x' cov⁻¹ x = sigmas², at that Mahalanobis distance, as a scaled and turned unit sphere.

    Those are the lengths of its half axes (3,), and the unit quaternion (w, x, y, z) that turns them into place; `cov`
    (3, 3) is symmetric positive semidefinite.
    """
    values, vectors = np.linalg.eigh(cov)
    if np.linalg.det(vectors) < 0:
        vectors[:, 0] = -vectors[:, 0]
    return sigmas * np.sqrt(np.maximum(values, 0.0)), quaternion(vectors)


def quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """Return the unit quaternion (w, x, y, z) of a rotation matrix, from its largest component.

    Source: Shepperd (1978), doi:10.2514/3.55767b.
    """
    m = rotation
    trace = np.trace(m)
    k = int(np.argmax([trace, m[0, 0], m[1, 1], m[2, 2]]))
    if k == 0:
        q = np.array([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    else:
        a, b, c = (k - 1, k % 3, (k + 1) % 3)
        q = np.zeros(4)
        q[0] = m[c, b] - m[b, c]
        q[1 + a] = 1 + m[a, a] - m[b, b] - m[c, c]
        q[1 + b] = m[a, b] + m[b, a]
        q[1 + c] = m[a, c] + m[c, a]
    w, x, y, z = q / np.linalg.norm(q)
    return float(w), float(x), float(y), float(z)


def about_z(angle: float) -> tuple[float, float, float, float]:
    """Return the quaternion of a turn to the left about the vertical, in radians."""
    return float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2))


def segments(points: np.ndarray) -> np.ndarray:
    """Return a polyline (n, 3) as segments (n - 1, 2, 3), without those at rows that are not finite."""
    pairs = np.stack((points[:-1], points[1:]), axis=1) if len(points) > 1 else np.zeros((0, 2, 3))
    pairs = pairs[np.isfinite(pairs).all(axis=(1, 2))]
    return pairs.astype(np.float32) if len(pairs) else NO_LINE


SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], float)
"""Corners (5, 2) of the square from -1 to 1, once around."""


SIDES = 64  # Sides of a disc


def disc() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a flat disc of radius 1 in the plane z = 0."""
    k = np.arange(SIDES)
    faces = np.stack((np.full(SIDES, SIDES), k, (k + 1) % SIDES), axis=1)
    rim = on_circle(np.linspace(0, 2 * np.pi, SIDES, endpoint=False))
    return np.vstack((rim, np.zeros(3))).astype(np.float32), faces.astype(np.uint32)


def circle() -> np.ndarray:
    """Return the rim of that disc as segments (SIDES, 2, 3)."""
    return segments(on_circle(np.linspace(0, 2 * np.pi, SIDES + 1)))


def on_circle(angle: np.ndarray) -> np.ndarray:
    """Return the points (n, 3) of the circle of radius 1 in the plane z = 0 at some angles."""
    return np.stack((np.cos(angle), np.sin(angle), np.zeros(angle.size)), axis=1)


NO_LINE, NO_POINT = np.zeros((1, 2, 3), np.float32), np.zeros((1, 3), np.float32)
"""In place of empty lines or points, of which Viser draws nothing sensible."""

UNSHADED = {"cast_shadow": False, "receive_shadow": False}


class Shapes:
    """Adds shapes below one path: lines as thick as pixels, flat dots, bodies without shadows."""

    def __init__(self, api: viser.SceneApi, path: str = "/scene") -> None:
        self.api, self.path = api, path

    def below(self, name: str) -> Shapes:
        """Return the same below another path."""
        return Shapes(self.api, f"{self.path}/{name}")

    def frame(self, **more: object) -> viser.FrameHandle:
        """Add a frame at the path; removing it removes all below."""
        return self.api.add_frame(self.path, show_axes=False, **more)

    def lines(
        self, name: str, color: RGB, thickness: float, points: np.ndarray = NO_LINE, **more: object
    ) -> viser.LineSegmentsHandle:
        """Add line segments (n, 2, 3)."""
        path = f"{self.path}/{name}"
        return self.api.add_line_segments(path, points, color, thickness=thickness, thickness_units="screen", **more)

    def dots(
        self, name: str, color: object, size: float, points: np.ndarray = NO_POINT, shape: str = "circle", **more: Any
    ) -> viser.PointCloudHandle:
        """Add points (n, 3) of one colour, or of a colour each."""
        style: dict[str, object] = {"precision": "float32", "point_shading": "flat", "point_shape": shape, **more}
        return self.api.add_point_cloud(f"{self.path}/{name}", points, color, point_size=size, **style)

    def label(self, name: str, text: str = " ", scale: float = 0.75, **more: object) -> viser.LabelHandle:
        """Add a text."""
        return self.api.add_label(f"{self.path}/{name}", text, font_screen_scale=scale, **more)

    def body(self, kind: str, name: str, *form: object, **more: object) -> viser.MeshHandle:
        """Add a body of a kind of Viser's: box, cylinder, icosphere, mesh_simple, image."""
        return getattr(self.api, f"add_{kind}")(f"{self.path}/{name}", *form, **UNSHADED, **more)


def set_text(label: viser.LabelHandle, text: str) -> None:
    """Set a text, and send it only if it is another one."""
    if label.text != text:
        label.text = text


def set_color(handle: viser.MeshHandle, color: RGB) -> None:
    """Set a colour, and send it only if it is another one."""
    if tuple(handle.color) != tuple(color):
        handle.color = color


def put_points(handle: viser.PointCloudHandle | viser.LineSegmentsHandle, points: np.ndarray) -> None:
    """Draw the finite ones of points (n, 3) or of lines (n, 2, 3); hide the handle without any."""
    points = points[np.isfinite(points).all(axis=tuple(range(1, points.ndim)))]
    handle.visible = bool(len(points))
    if len(points):
        handle.points = points.astype(np.float32)


class PeakMarks:
    """A dot with its weight at each of several peaks of an estimate."""

    def __init__(self, shapes: Shapes, count: int, color: RGB, size: float, scale: float = 1.0) -> None:
        self.handles = [
            (
                shapes.dots(f"peaks/{k}/mean", color, size, visible=False),
                shapes.label(f"peaks/{k}/weight", scale=scale, visible=False, anchor="bottom-left"),
            )
            for k in range(count)
        ]

    def draw(self, places: Sequence[np.ndarray], texts: Sequence[str], beside: Sequence[float]) -> None:
        """Draw the marks at places (3,), NaN for none, with their texts `beside` (3,) them."""
        for k, (dot, label) in enumerate(self.handles):
            shown = k < len(places) and bool(np.isfinite(places[k]).all())
            if shown:
                dot.points = places[k][None].astype(np.float32)
                label.position, label.text = tuple(places[k] + beside), texts[k]
            dot.visible = label.visible = shown


_EVENTS = ("t", "kind", "channel", "value")
_COLUMNS = (*_EVENTS, "mean", "std", "verdict")


class History:
    """A sliding copy of the track: the last `span` nanoseconds, and never more than `2 * limit` rows.

    Row i of the arrays is event `base + i` of the log. Rows that a late measurement or another revision rewrites are
    pulled again and overwrite the rows from there on.
    """

    def __init__(self, nx: int, width: int, limit: int = 32_768) -> None:
        self.limit = limit
        self.span: int | None = None
        self.base = 0
        self.n = 0
        shapes = {"value": (width,), "mean": (nx,), "std": (nx,)}
        kinds = {"t": np.int64, "kind": np.int8, "channel": np.int32, "verdict": np.int8}
        self._columns = {
            name: np.zeros((2 * limit, *shapes.get(name, ())), kinds.get(name, np.float64)) for name in _COLUMNS
        }

    def column(self, name: str) -> np.ndarray:
        """Return the valid rows of one column, as a view."""
        return self._columns[name][: self.n]

    def events(self, rows: slice = slice(None)) -> Events:
        """Return valid rows as events, as views, with the time of measurement as the time of arrival."""
        t, kind, channel, value = (self.column(name)[rows] for name in ("t", "kind", "channel", "value"))
        return Events(t, t, kind, channel, value)

    def settled(self, name: str, rows: int) -> np.ndarray:
        """Return the newest rows of a column, of each time only the last, after all its sensors."""
        t = self.column("t")[-4 * rows :]
        last = np.append(t[1:] != t[:-1], [True] * bool(t.size))
        return self.column(name)[-4 * rows :][last.astype(bool)][-rows:]

    def clear(self) -> None:
        """Drop all rows."""
        self.base, self.n = 0, 0

    def update(self, pull: Pull) -> int:
        """Write a pull of at most `limit` rows into the arrays; return the first changed row: all after it did too."""
        count = len(pull.events)
        if pull.fresh or not self.n or not self.base <= pull.first <= self.base + self.n:
            self.base, self.n = pull.first, 0
        if not count:
            return self.n
        start = pull.first - self.base
        if start + count > 2 * self.limit:
            start -= self._drop(start - self.limit)
        for name, column in self._columns.items():
            batch = getattr(pull.events if name in _EVENTS else pull.track, name)
            # The variances of measurements, in columns after the values, are not drawn.
            column[start : start + count] = batch[:, : column.shape[1]] if column.ndim > 1 else batch
        self.n = start + count
        return start

    def trim(self) -> int:
        """Drop rows older than the span, once they are a third of all; return how many, by which row numbers fall."""
        if self.span is None or not self.n:
            return 0
        drop = int(np.searchsorted(self.column("t"), self._columns["t"][self.n - 1] - self.span))
        return self._drop(drop) if drop * 3 >= self.n else 0

    def _drop(self, rows: int) -> int:
        for column in self._columns.values():
            column[: self.n - rows] = column[rows : self.n].copy()
        self.base += rows
        self.n -= rows
        return rows


MARGIN = 0.94  # Share of the view that the points fill

MAX_TURNED_DISTANCE = 0.75
"""A scene is turned by a right angle if this then reduces the camera's distance to that share or less."""

MAX_SIGHT = 20_000.0  # Distance up to which a camera sees; a road may be long
MAX_ASPECT_CHANGE = 0.02  # Relative change of a pane's aspect from which the camera is placed again


class Outlook(NamedTuple):
    """Points that a camera should see, and where it looks from.

    points: About the origin, shape (n, 3).
    direction: From the origin to the camera, shape (3,).
    up: Direction that is up on the screen, shape (3,), not parallel to `direction`.
    fov: Angle from top to bottom, radians.
    turns: Whether the scene may be turned by a right angle to the right about z, to fill a narrow pane better.
    """

    points: np.ndarray
    direction: np.ndarray
    up: np.ndarray = np.array([0.0, 0.0, 1.0])
    fov: float = float(np.radians(20))
    turns: bool = False

    @staticmethod
    def from_above(points: np.ndarray) -> Outlook:
        """Return the view of a plane from far above, as on paper, with y up on the screen."""
        return Outlook(points, np.array([0.0, -0.001, 1.0]), np.array([0.0, 1.0, 0.0]), float(np.radians(9.2)))


def place(outlook: Outlook, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Return position and up direction of a camera that looks at the origin, both (3,), so that it sees the points.

    `aspect` is the width of the view over its height.
    """
    straight = _distance(outlook, aspect)
    if outlook.turns:
        turned = outlook._replace(direction=_turned(outlook.direction), up=_turned(outlook.up))
        distance = _distance(turned, aspect)
        if distance < MAX_TURNED_DISTANCE * straight:
            return _unit(turned.direction) * distance, turned.up
    return _unit(outlook.direction) * straight, outlook.up


def _distance(outlook: Outlook, aspect: float) -> float:
    """Return the distance at which a camera sees the points, with a margin.

    A point c is seen if |c · r| <= tan(h/2) (d + c · f), with f forward, r to the right, h the angle across;
    likewise upwards, with the vertical angle.
    """
    forward = -_unit(outlook.direction)
    right = _unit(np.cross(forward, outlook.up))
    upright = np.tan(outlook.fov / 2)
    tangents = np.array([upright * max(aspect, 0.05), upright])
    aside = np.abs(outlook.points @ np.stack((right, np.cross(right, forward)), axis=1)) / (MARGIN * tangents)
    return float((aside.max(axis=1) - outlook.points @ forward).max())


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / np.linalg.norm(vector))


def _turned(vector: np.ndarray) -> np.ndarray:
    """Turn by a right angle to the right about z: north is left on the screen, east is up."""
    return np.array([vector[1], -vector[0], vector[2]])


class Cameras:
    """Places each browser's camera: when it connects, when its view changes its shape, and for another scene.

    Otherwise the user moves the camera.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._outlook: Outlook | None = None
        self._first: np.ndarray | None = None
        self._aspects: dict[int, float] = {}

        async def connected(client: viser.ClientHandle) -> None:
            client.camera.on_update(updated)
            self._fit(client.camera)

        async def updated(camera: viser.CameraHandle) -> None:
            known = self._aspects.get(camera.client.client_id)
            # A browser may move to the common initial position only after it got its own.
            begins = self._first is not None and np.allclose(camera.position, self._first, rtol=1e-4)
            if known is None or abs(camera.aspect - known) > MAX_ASPECT_CHANGE * known or begins:
                self._fit(camera)

        async def gone(client: viser.ClientHandle) -> None:
            self._aspects.pop(client.client_id, None)

        server.on_client_connect(connected)
        server.on_client_disconnect(gone)

    def show(self, outlook: Outlook) -> None:
        """Look at another scene."""
        if self._outlook is None:
            # Once only: it would move the cameras of connected browsers.
            camera = self._server.initial_camera
            self._first, camera.up = place(outlook, 1.0)
            camera.position = self._first
            camera.look_at, camera.fov, camera.far = np.zeros(3), outlook.fov, MAX_SIGHT
        self._outlook = outlook
        for client in self._server.get_clients().values():
            self._fit(client.camera)

    def _fit(self, camera: viser.CameraHandle) -> None:
        self._aspects[camera.client.client_id] = camera.aspect
        if self._outlook is None:
            return
        position, up = place(self._outlook, camera.aspect)
        with camera.client.atomic():
            camera.fov = self._outlook.fov
            camera.position = position
            camera.look_at = np.zeros(3)
            # Viser does not send a direction that it takes to be the browser's already, even if the browser has lost it
            # by moving to the common initial position: so send another one first.
            camera.up_direction = np.roll(up, 1)
            camera.up_direction = up
