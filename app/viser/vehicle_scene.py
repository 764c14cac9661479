"""The scene of a twin that moves on a plane: vehicle, track, walls, position readings, truth, particles, 2σ ellipse.

An estimate with several peaks has its vehicle at the heaviest one, and a dot with its weight at each: at the mean
between them is nobody.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from estimators.log import READING, truth_of
from estimators.model.state_space import StateSpaceModel
from estimators.track import FAILED, GATED

from ..drawing.direct_readings import observed
from ..drawing.geometry import about_z, circle, disc, ellipsoid, segments
from ..drawing.palette import Palette, mixed
from ..engine.outputs import Belief
from .camera import Outlook
from .history import History

TRAIL = 300
"""Points of a line where something was, at most."""

PEAKS = 4
POINTS = 600
"""Position readings of one sensor that are drawn at most."""

SOFTNESS = 0.3
"""Part of the way to the vehicle that the view moves in one frame."""

FOV = float(np.radians(40))
UP = np.array([0.0, 0.0, 1.0])

SLANTED = np.array([0.0, -0.68, 0.73])
"""From the vehicle to the first view of it."""

ABOVE = np.array([0.0, -0.12, 0.99])
"""From walls to the first view of them, nearly as on a plan: a corridor would else be a line."""

AROUND = 18.0
"""Metres around the vehicle that the first view shows where there are no walls; a vehicle is some 4 m long."""

NEAREST = 3.0
"""Metres around the middle of walls that the first view shows at least."""


class VehicleScene:
    """The plane with east to the right and north up the screen, under a camera that the user turns freely.

    In a pane that is higher than wide, long walls have their east up. The view follows by moving the world under the
    camera, never the camera: a user's own turning and zooming is not disturbed, and coordinates near the camera stay
    small, which single precision needs.
    """

    def __init__(self, api: viser.SceneApi, model: StateSpaceModel, scene: Any, palette: Palette) -> None:
        names = model.state_names
        self.east, self.north = (names.index(name) for name in scene.position)
        self.heading = names.index(scene.heading) if scene.heading else None
        dots = observed(model)
        self._fixes = [
            (dot.sensor, dot.row, other.row)
            for dot in dots
            for other in dots
            if dot.sensor == other.sensor and (dot.state, other.state) == (self.east, self.north)
        ]
        corners = np.array([corner for line in scene.walls for corner in line]).reshape(-1, 2)
        # Among walls the place is what matters, all of it: two peaks may be at its two ends.
        self._home = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) if corners.size else None
        self.follow = self._home is None
        self._anchor: np.ndarray | None = None if self._home is None else self._home.copy()
        self._course = 0.0
        self._known = False
        self.root = api.add_frame("/scene", show_axes=False)
        self.world = api.add_frame("/scene/world", show_axes=False)
        self._grid = api.add_grid(
            "/scene/grid", infinite_grid=True, cell_size=10.0, section_size=50.0, fade_distance=900.0,
            cell_color=palette.grid, section_color=palette.rule, shadow_opacity=0.0,
        )  # fmt: skip
        line, world = {"thickness_units": "screen"}, "/scene/world"
        nothing = np.zeros((1, 2, 3), np.float32)
        self._trail = api.add_line_segments(f"{world}/trail", nothing, palette.estimate, thickness=3, **line)
        self._truth = api.add_line_segments(f"{world}/truth", nothing, palette.truth, thickness=2, **line)
        dot = {"point_shape": "circle", "precision": "float32", "point_shading": "flat", "visible": False}
        one = np.zeros((1, 3), np.float32)
        self._readings, self._refused = (
            api.add_point_cloud(f"{world}/{name}", one, color, point_size=0.5, **dot)
            for name, color in (("readings", palette.reading), ("refused", palette.refused))
        )
        vertices, faces = disc()
        self._ellipse = api.add_mesh_simple(
            f"{world}/ellipse", vertices, faces, color=palette.estimate, opacity=0.25, side="double",
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._rim = api.add_line_segments(f"{world}/rim", circle(), palette.estimate, thickness=2, **line)
        walls = [segments(np.array([(*corner, 0.3) for corner in line])) for line in scene.walls]
        if walls:
            api.add_line_segments(f"{world}/walls", np.concatenate(walls), palette.faint, thickness=3, **line)
        light = mixed(palette.estimate, palette.panel, 0.2)
        self._cloud = api.add_point_cloud(f"{world}/cloud", one, light, point_size=0.15, **dot)
        self._peaks = [
            (
                api.add_point_cloud(f"{world}/peaks/{k}/mean", one, palette.estimate, point_size=0.6, **dot),
                api.add_label(f"{world}/peaks/{k}/weight", " ", visible=False, anchor="bottom-left"),
            )
            for k in range(PEAKS)
        ]
        self._vehicle = api.add_frame(f"{world}/vehicle", show_axes=False)
        dark, pale = mixed(palette.estimate, palette.ink, 0.3), mixed(palette.estimate, palette.panel, 0.5)
        api.add_box(f"{world}/vehicle/body", dark, (4.4, 1.8, 0.7), position=(0, 0, 0.65), cast_shadow=False)
        api.add_box(f"{world}/vehicle/cabin", pale, (2.2, 1.6, 0.6), position=(-0.3, 0, 1.3), cast_shadow=False)
        around = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        if self._home is None:
            self.outlook = Outlook(AROUND * around, SLANTED, UP, FOV)
        else:
            outline = np.column_stack((corners - self._home, np.zeros(len(corners))))
            self.outlook = Outlook(np.vstack((outline, NEAREST * around)), ABOVE, UP, FOV, turns=True)
        self._move_world()

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send where everything is now; lines, readings and particles only if `heavy`."""
        if not history.n:
            return
        mean = history.column("mean")
        known = bool(np.isfinite(belief.mean[[self.east, self.north]]).all())
        # What was drawn before would else stand for an estimate that is not a number.
        heavy |= known != self._known
        self._known = known
        self._vehicle.visible = known
        self._mark(belief.peaks if known else ())
        if heavy:
            self._trail.points = segments(self._plane(mean[:, self.east], mean[:, self.north], 0.06))
            self._draw_truth(history)
            self._draw_readings(history)
            self._draw_cloud(belief.points if known else ())
        if known:
            self._draw_vehicle(mean, belief)
        else:
            self._draw_ellipse(np.zeros(2), np.full((2, 2), np.nan))

    def _draw_vehicle(self, mean: np.ndarray, belief: Belief) -> None:
        """Move the vehicle with its ellipse, and the world under the camera."""
        # A mean between two peaks is nowhere.
        peak = belief.peaks[0] if len(belief.peaks) > 1 else belief
        here = peak.mean[[self.east, self.north]]
        middle = here if self.follow or self._home is None else self._home
        if self._anchor is None or np.linalg.norm(middle - self._anchor) > 200.0:
            self._anchor = middle.copy()
        if self.follow or self._home is not None:
            self._anchor += SOFTNESS * (middle - self._anchor)
        self._move_world()
        self._vehicle.position = (*here, 0.0)
        self._vehicle.wxyz = about_z(self._direction(peak, mean))
        self._draw_ellipse(here, peak.cov[np.ix_([self.east, self.north], [self.east, self.north])])

    def _move_world(self) -> None:
        """Bring what is to be in the middle there."""
        if self._anchor is None:
            return
        shift = np.array([*-self._anchor, 0.0])
        self.world.position = shift
        # The grid is endless: only where its lines fall matters.
        self._grid.position = (*np.mod(shift[:2], 50.0), 0.0)

    def _draw_ellipse(self, here: np.ndarray, cov: np.ndarray) -> None:
        known = bool(np.isfinite(cov).all())
        self._ellipse.visible = self._rim.visible = known
        if not known:
            return
        full = np.zeros((3, 3))
        full[:2, :2] = cov
        full[2, 2] = 2 * full.max() + 1.0  # the largest, so that the ellipse is the first two axes
        axes, turn = ellipsoid(full)
        for handle in (self._ellipse, self._rim):
            handle.position, handle.wxyz = (*here, 0.04), turn
            handle.scale = (float(axes[0]), float(axes[1]), 1.0)

    def _plane(self, east: np.ndarray, north: np.ndarray, height: float) -> np.ndarray:
        pick = np.unique(np.linspace(0, east.size - 1, min(east.size, TRAIL)).astype(int))
        return np.stack((east[pick], north[pick], np.full(pick.size, height)), axis=1)

    def _draw_truth(self, history: History) -> None:
        events = history.events()
        (in_east, east), (in_north, north) = (truth_of(events, j) for j in (self.east, self.north))
        times, of_east, of_north = np.intersect1d(events.t[in_east], events.t[in_north], return_indices=True)
        if times.size:
            self._truth.points = segments(self._plane(east[of_east], north[of_north], 0.05))

    def _draw_readings(self, history: History) -> None:
        kind, channel, value = (history.column(name) for name in ("kind", "channel", "value"))
        refused = np.isin(history.column("verdict"), (GATED, FAILED))
        for handle, wanted in ((self._readings, ~refused), (self._refused, refused)):
            parts = [np.zeros((0, 3))]
            for sensor, row, row_n in self._fixes:
                mine = np.flatnonzero((kind == READING) & (channel == sensor) & wanted)[-POINTS:]
                parts.append(np.stack((value[mine, row], value[mine, row_n], np.full(mine.size, 0.1)), axis=1))
            _put(handle, np.concatenate(parts))

    def _draw_cloud(self, points: Any) -> None:
        """The points that stand for the belief."""
        plane = points[:, [self.east, self.north]] if len(points) else np.zeros((0, 2))
        _put(self._cloud, np.column_stack((plane, np.full(len(plane), 0.2))))

    def _mark(self, peaks: Any) -> None:
        """A dot with its weight at each peak, where there are several."""
        several = peaks if len(peaks) > 1 else ()
        for k, (dot, label) in enumerate(self._peaks):
            place = several[k].mean[[self.east, self.north]] if k < len(several) else np.full(2, np.nan)
            shown = bool(np.isfinite(place).all())
            if shown:
                dot.points = np.array([(*place, 1.2)], np.float32)
                label.position = (*(place + 0.6), 1.2)
                label.text = f"{100 * several[k].weight:.0f} %"
            dot.visible = label.visible = shown

    def _direction(self, peak: Any, mean: np.ndarray) -> float:
        if self.heading is not None:
            if np.isfinite(peak.mean[self.heading]):
                self._course = float(peak.mean[self.heading])
            return self._course
        step = mean[-1, [self.east, self.north]] - mean[max(0, len(mean) - 20), [self.east, self.north]]
        if np.hypot(*step) > 1.0:  # not so if one of the two is NaN
            self._course = float(np.arctan2(step[1], step[0]))
        return self._course


def _put(handle: Any, points: np.ndarray) -> None:
    points = points[np.isfinite(points).all(axis=1)]
    handle.visible = bool(len(points))
    if len(points):
        handle.points = points.astype(np.float32)
