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

from ..drawing.direct_readings import observed
from ..drawing.geometry import about_z, circle, disc, ellipsoid, segments
from ..engine.outputs import Belief
from .camera import distance_for, fit_cameras
from .history import History

TRAIL = 600
PEAKS = 4
POINTS = 1500
SOFTNESS = 0.3
"""Part of the way to the vehicle that the view moves in one frame."""

FOV = float(np.radians(40))

ABOVE = np.array([0.0, -0.28, 0.96])
"""From walls to the first view of them, nearly as on a plan: a corridor would else be a line."""

NEAREST = 15.0
"""Metres from which the first view looks at walls at least: a vehicle is some 4 m long."""


class VehicleScene:
    """The plane with east to the right and north up the screen, under a camera that the user turns freely.

    The view follows by moving the world under the camera, never the camera: a user's own turning and zooming is not
    disturbed, and coordinates near the camera stay small, which single precision needs.
    """

    def __init__(self, server: viser.ViserServer, model: StateSpaceModel, scene: Any) -> None:
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
        api = server.scene
        api.set_up_direction("+z")
        self.world = api.add_frame("/world", show_axes=False)
        self._grid = api.add_grid(
            "/grid", infinite_grid=True, cell_size=10.0, section_size=50.0, fade_distance=900.0,
            cell_color=(226, 232, 240), section_color=(186, 196, 210), shadow_opacity=0.0,
        )  # fmt: skip
        line = {"thickness_units": "screen"}
        nothing = np.zeros((1, 2, 3), np.float32)
        self._trail = api.add_line_segments("/world/trail", nothing, (37, 99, 235), thickness=3, **line)
        self._truth = api.add_line_segments("/world/truth", nothing, (22, 163, 74), thickness=2, **line)
        self._readings = api.add_point_cloud(
            "/world/readings", np.zeros((1, 3), np.float32), (245, 158, 11), point_size=0.5, point_shape="circle",
            precision="float32", point_shading="flat", visible=False,
        )  # fmt: skip
        vertices, faces = disc()
        self._ellipse = api.add_mesh_simple(
            "/world/ellipse", vertices, faces, color=(96, 146, 246), opacity=0.35, side="double", cast_shadow=False,
            receive_shadow=False,
        )  # fmt: skip
        self._rim = api.add_line_segments("/world/rim", circle(), (37, 99, 235), thickness=2, **line)
        walls = [segments(np.array([(*corner, 0.3) for corner in line])) for line in scene.walls]
        if walls:
            api.add_line_segments("/world/walls", np.concatenate(walls), (71, 85, 105), thickness=3, **line)
        dot = {"point_shape": "circle", "precision": "float32", "point_shading": "flat", "visible": False}
        one = np.zeros((1, 3), np.float32)
        self._cloud = api.add_point_cloud("/world/cloud", one, (124, 58, 237), point_size=0.15, **dot)
        self._peaks = [
            (
                api.add_point_cloud(f"/world/peaks/{k}/mean", one, (190, 24, 93), point_size=0.6, **dot),
                api.add_label(f"/world/peaks/{k}/weight", " ", visible=False, anchor="bottom-left"),
            )
            for k in range(PEAKS)
        ]
        self._vehicle = api.add_frame("/world/vehicle", show_axes=False)
        api.add_box("/world/vehicle/body", (30, 64, 175), (4.4, 1.8, 0.7), position=(0, 0, 0.65), cast_shadow=False)
        api.add_box(
            "/world/vehicle/cabin", (147, 180, 245), (2.2, 1.6, 0.6), position=(-0.3, 0, 1.3), cast_shadow=False
        )
        camera = server.initial_camera
        camera.position, camera.look_at, camera.up = (0.0, -55.0, 60.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
        if self._home is not None:
            outline = np.column_stack((corners - self._home, np.zeros(len(corners))))
            camera.position = ABOVE * max(NEAREST, distance_for(outline, ABOVE, FOV))
        camera.far = 20_000.0
        fit_cameras(server, FOV)
        self._move_world()

    def controls(self, gui: viser.GuiApi) -> None:
        """What a user may choose about the scene."""
        rest = "" if self._home is None else "; else the whole of the walls"
        follow = gui.add_checkbox("Follow", self.follow, hint=f"Keep the vehicle in the middle{rest}")

        @follow.on_update
        def _(event: viser.GuiEvent) -> None:
            self.follow = follow.value

    def draw(self, history: History, belief: Belief) -> None:
        """Send where everything is now."""
        if not history.n:
            return
        mean = history.column("mean")
        self._trail.points = segments(self._plane(mean[:, self.east], mean[:, self.north], 0.06))
        self._draw_truth(history)
        self._draw_readings(history)
        known = bool(np.isfinite(belief.mean[[self.east, self.north]]).all())
        # What was drawn before would else stand for an estimate that is not a number.
        self._vehicle.visible = known
        self._draw_cloud(belief.points if known else (), belief.peaks if known else ())
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
        parts = []
        for sensor, row, row_n in self._fixes:
            mine = np.flatnonzero((kind == READING) & (channel == sensor))[-POINTS:]
            parts.append(np.stack((value[mine, row], value[mine, row_n], np.full(mine.size, 0.1)), axis=1))
        points = np.concatenate(parts) if parts else np.zeros((0, 3))
        points = points[np.isfinite(points).all(axis=1)]
        self._readings.visible = bool(len(points))
        if len(points):
            self._readings.points = points

    def _draw_cloud(self, points: Any, peaks: Any) -> None:
        """The points that stand for the belief, and a dot with its weight at each peak, where there are several."""
        plane = [self.east, self.north]
        points = points[:, plane] if len(points) else np.zeros((0, 2))
        points = points[np.isfinite(points).all(axis=1)]
        self._cloud.visible = bool(len(points))
        if len(points):
            self._cloud.points = np.column_stack((points, np.full(len(points), 0.2))).astype(np.float32)
        several = peaks if len(peaks) > 1 else ()
        for k, (dot, label) in enumerate(self._peaks):
            shown = k < len(several) and bool(np.isfinite(several[k].mean[plane]).all())
            if shown:
                place = (*several[k].mean[plane], 1.2)
                dot.points = np.array([place], np.float32)
                label.position = place
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
