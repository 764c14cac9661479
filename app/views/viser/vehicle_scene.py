"""The scene of a twin that moves on a plane: vehicle, track, walls, beams, beacons, readings, truth, particles, 2σ.

The vehicle has its true size; a pointer, as thick at any distance, says where it is in a place that is large. An
estimate with several peaks has its vehicle at the heaviest one, and a dot with its weight at each: at the mean between
them is nobody.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import viser

from estimators.log import READING, truth_of
from estimators.model.state_space import StateSpaceModel
from estimators.track import FAILED, GATED
from estimators.tuning import Tuning

from ...live.outputs import Belief
from ...present.drawing.colors import Palette, mixed, round_step
from ...present.drawing.direct_readings import expected, observed
from .scene import History, Outlook, about_z, circle, disc, ellipsoid, segments

UNSURE = 20.0
"""Multiple of the median deviation from which a position is left out of the trail."""

LEAP = 20.0
"""Multiple of the median step from which a step of the trail is drawn as a gap."""

TRAIL = 300
"""Largest number of points of a trail."""

PEAKS = 4
POINTS = 600
"""Largest number of position measurements of a sensor."""

SOFTNESS = 0.3
"""Share of the way to the vehicle that the view moves in one frame."""

FOV = float(np.radians(40))
UP = np.array([0.0, 0.0, 1.0])

SLANTED = np.array([0.0, -0.68, 0.73])
"""Direction from the vehicle to the initial camera."""

ABOVE = np.array([0.0, -0.12, 0.99])
"""Direction from walls to the initial camera, nearly from above: a corridor would otherwise be a line."""

AROUND = 4.0
"""Radius of the initial view without walls and beacons, in lengths of the vehicle."""

NEAREST = 0.7
"""Smallest radius of the initial view with walls or beacons, in lengths of the vehicle."""

BESIDE = 1.2
"""Factor by which the initial view reaches beyond the beacons, for their names."""

LARGE = 2.5
"""Multiple of the view's radius from which an ellipse is drawn as an outline only."""


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
        self.tuning = Tuning.of(model)
        walled = np.array([corner for line in scene.walls for corner in line]).reshape(-1, 2)
        standing = BeaconPositions(model, scene.beacons.values()).at(model.prior_mean, self.tuning.p)
        corners = np.concatenate((walled, standing))
        # With walls or beacons the view shows all of them: two peaks may be at opposite ends.
        self._home = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) if corners.size else None
        self._length = scene.size[0]
        self._reach = AROUND * self._length
        if self._home is not None:
            self._reach = max(NEAREST * self._length, float(np.abs(corners - self._home).max()))
        # Size of dots.
        dot_size = self._reach / 36.0
        self.follow = self._home is None
        self._anchor: np.ndarray | None = None if self._home is None else self._home.copy()
        self._course = 0.0
        self._known = False
        self.root = api.add_frame("/scene", show_axes=False)
        self.world = api.add_frame("/scene/world", show_axes=False)
        cell = round_step(0.4 * self._reach)
        self._section = 5 * cell
        self._grid = api.add_grid(
            "/scene/grid", infinite_grid=True, cell_size=cell, section_size=self._section, fade_distance=90 * cell,
            cell_color=palette.grid, section_color=palette.rule, shadow_opacity=0.0,
        )  # fmt: skip
        line, world = {"thickness_units": "screen"}, "/scene/world"
        nothing = np.zeros((1, 2, 3), np.float32)
        self._trail = api.add_line_segments(f"{world}/trail", nothing, palette.estimate, thickness=3, **line)
        self._way = PeakTrail()
        self._truth = api.add_line_segments(f"{world}/truth", nothing, palette.truth, thickness=2, **line)
        dot = {"point_shape": "circle", "precision": "float32", "point_shading": "flat", "visible": False}
        one = np.zeros((1, 3), np.float32)
        self._readings, self._refused = (
            api.add_point_cloud(f"{world}/{name}", one, color, point_size=dot_size, **dot)
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
        self._cloud = api.add_point_cloud(f"{world}/cloud", one, light, point_size=0.3 * dot_size, **dot)
        self._peaks = [
            (
                api.add_point_cloud(f"{world}/peaks/{k}/mean", one, palette.estimate, point_size=0.8 * dot_size, **dot),
                api.add_label(f"{world}/peaks/{k}/weight", " ", visible=False, anchor="bottom-left"),
            )
            for k in range(PEAKS)
        ]
        self._vehicle = api.add_frame(f"{world}/vehicle", show_axes=False)
        add_body(api, f"{world}/vehicle", scene.size, palette)
        pointer = np.array([[[0.0, 0.0, 0.02], [max(0.9 * self._length, 0.12 * self._reach), 0.0, 0.02]]], np.float32)
        api.add_line_segments(f"{world}/vehicle/pointer", pointer, palette.estimate, thickness=5, **line)
        self._beams = self._beacons = None
        if scene.beams:
            self._beams = Beams(api, f"{world}/beams", model, scene.beams, palette, dot=0.5 * dot_size)
        if scene.beacons:
            self._beacons = Beacons(api, f"{world}/beacons", model, scene.beacons, palette, size=2 * dot_size)
        around = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        if self._home is None:
            self.outlook = Outlook(self._reach * around, SLANTED, UP, FOV)
        else:
            outline = np.column_stack((corners - self._home, np.zeros(len(corners))))
            outline[len(walled) :] *= BESIDE
            self.outlook = Outlook(np.vstack((outline, NEAREST * self._length * around)), ABOVE, UP, FOV, turns=True)
        self._move_world()

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send the present positions; lines, measurements and particles only if `heavy`."""
        if not history.n:
            return
        mean = history.column("mean")
        known = bool(np.isfinite(belief.mean[[self.east, self.north]]).all())
        # Otherwise the earlier drawing would stay for an estimate that is not a number.
        heavy |= known != self._known
        self._known = known
        self._vehicle.visible = known
        self._mark(belief.peaks if known else ())
        plane, t = mean[:, [self.east, self.north]], history.column("t")
        std = history.column("std")[:, [self.east, self.north]]
        several = known and len(belief.peaks) > 1
        self._way.look(t, plane, belief.peaks[0].mean[[self.east, self.north]] if several else None)
        if heavy:
            east, north = self._way.of(t, where_known(plane, std)).T
            self._trail.points = segments(without_jumps(self._plane(east, north, 0.06)))
            self._draw_truth(history)
            self._draw_readings(history)
            self._draw_cloud(belief.points if known else ())
            if self._beacons is not None:
                self._beacons.draw(history, belief.mean, self.tuning.p)
        if known:
            peak = belief.peaks[0] if len(belief.peaks) > 1 else belief  # a mean between two peaks is nowhere
            self._draw_vehicle(mean, peak)
            if self._beams is not None:
                here = peak.mean[[self.east, self.north]]
                self._beams.draw(history, peak.mean, here, self._course, self.tuning.p)
        else:
            self._draw_ellipse(np.zeros(2), np.full((2, 2), np.nan))
            if self._beams is not None:
                self._beams.hide()

    def _draw_vehicle(self, mean: np.ndarray, peak: Any) -> None:
        """Move the vehicle with its ellipse, and the world under the camera."""
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
        """Move the world so that the anchor is in the middle of the view."""
        if self._anchor is None:
            return
        shift = np.array([*-self._anchor, 0.0])
        self.world.position = shift
        # The grid is endless, so only the phase of its lines matters.
        self._grid.position = (*np.mod(shift[:2], self._section), 0.0)

    def _draw_ellipse(self, here: np.ndarray, cov: np.ndarray) -> None:
        known = bool(np.isfinite(cov).all())
        self._ellipse.visible = self._rim.visible = known
        if not known:
            return
        full = np.zeros((3, 3))
        full[:2, :2] = cov
        full[2, 2] = 2 * full.max() + 1.0  # the largest, so that the ellipse is the first two axes
        axes, turn = ellipsoid(full)
        self._ellipse.visible = bool(axes[1] < LARGE * self._reach)
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
        """Draw the particles."""
        plane = points[:, [self.east, self.north]] if len(points) else np.zeros((0, 2))
        _put(self._cloud, np.column_stack((plane, np.full(len(plane), 0.2))))

    def _mark(self, peaks: Any) -> None:
        """Draw a dot with its weight at each of several peaks."""
        several = peaks if len(peaks) > 1 else ()
        for k, (dot, label) in enumerate(self._peaks):
            place = several[k].mean[[self.east, self.north]] if k < len(several) else np.full(2, np.nan)
            shown = bool(np.isfinite(place).all())
            if shown:
                dot.points = np.array([(*place, 1.2)], np.float32)
                label.position = (*(place + 0.6), 1.2)
                # At the heaviest stand the vehicle and the end of its trail.
                label.text = f"{100 * several[k].weight:.0f} %{' drawn' if k == 0 else ''}"
            dot.visible = label.visible = shown

    def _direction(self, peak: Any, mean: np.ndarray) -> float:
        if self.heading is not None:
            if np.isfinite(peak.mean[self.heading]):
                self._course = float(peak.mean[self.heading])
            return self._course
        step = mean[-1, [self.east, self.north]] - mean[max(0, len(mean) - 20), [self.east, self.north]]
        if np.hypot(*step) > 0.2 * self._length:  # not so if one of the two is NaN
            self._course = float(np.arctan2(step[1], step[0]))
        return self._course


def without_jumps(way: np.ndarray) -> np.ndarray:
    """A way (n, 3) with gaps where it leaps: a cloud found its vehicle elsewhere, which did not drive there."""
    steps = np.hypot(*np.diff(way[:, :2], axis=0).T)
    moving = steps[steps > 0.0]
    leaps = np.flatnonzero(steps > LEAP * np.median(moving)) if moving.size else moving.astype(int)
    return np.insert(way, leaps + 1, np.nan, axis=0)


def where_known(plane: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Return positions (n, 2), NaN where their deviations (n, 2) are far larger than usual, as those of a prior are."""
    spread = np.hypot(*std.T)
    known = spread <= UNSURE * np.nanmedian(spread) if np.isfinite(spread).any() else np.ones(len(plane), bool)
    return np.where(known[:, None], plane, np.nan)


def add_body(api: viser.SceneApi, name: str, size: tuple[float, float, float], palette: Palette) -> None:
    """A body of that length, width and height, m, about a place on the ground, its front along x: its nose is pale."""
    long, wide, tall = size
    dark, pale = mixed(palette.estimate, palette.ink, 0.3), mixed(palette.estimate, palette.panel, 0.5)
    flat = {"cast_shadow": False, "receive_shadow": False}
    api.add_box(f"{name}/body", dark, (long, wide, 0.5 * tall), position=(0, 0, 0.4 * tall), **flat)
    api.add_box(
        f"{name}/cabin", pale, (0.5 * long, 0.9 * wide, 0.35 * tall), position=(-0.07 * long, 0, 0.825 * tall), **flat
    )


def _put(handle: Any, points: np.ndarray) -> None:
    points = points[np.isfinite(points).all(axis=1)]
    handle.visible = bool(len(points))
    if len(points):
        handle.points = points.astype(np.float32)


MAX_FRAMES = 4096
"""Frames that are kept."""


class PeakTrail:
    """Frames of one scene: time, mean of its row, and the heaviest of several peaks, or NaN."""

    def __init__(self) -> None:
        self._looks: list[tuple[int, np.ndarray, np.ndarray]] = []

    def look(self, t: np.ndarray, mean: np.ndarray, peak: np.ndarray | None) -> None:
        """Keep the frame of the newest row.

        Args:
            t: Times of the rows, ns, (n,).
            mean: Position by the mean of each, (n, 2).
            peak: Position of the heaviest of several peaks, (2,); None if there is one.
        """
        if self._looks:
            then, place, _ = self._looks[-1]
            row = min(int(np.searchsorted(t, then, side="right")) - 1, len(t) - 1)
            # Rows that were rewritten, by another filter or a late measurement, had other peaks.
            if then > t[-1] or row >= 0 and t[row] == then and not np.array_equal(mean[row], place, equal_nan=True):
                self._looks.clear()
        seen = np.full(2, np.nan) if peak is None else np.array(peak, float)
        if self._looks and self._looks[-1][0] == t[-1]:
            self._looks.pop()
        self._looks = [*self._looks[-MAX_FRAMES + 1 :], (int(t[-1]), mean[-1].copy(), seen)]

    def of(self, t: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Return the trail, (m, 2): the mean, or the heaviest peak where there were several."""
        if not self._looks or not any(np.isfinite(peak[0]) for *_, peak in self._looks):
            return mean
        looks = np.array([then for then, *_ in self._looks])
        peaks = np.array([peak for *_, peak in self._looks])
        several = np.isfinite(peaks[:, 0])
        # The frame after each row; rows after the last frame are treated like it.
        led = np.minimum(np.searchsorted(looks, t), len(looks) - 1)
        kept = ~several[led]
        peaked = several & (looks >= t[0])
        times = np.concatenate((t[kept], looks[peaked]))
        return np.concatenate((mean[kept], peaks[peaked]))[np.argsort(times, kind="stable")]


FADING_S = 10.0
"""Seconds over which a ring pales; then it is gone."""

SIDES = 180


class BeaconPositions:
    """Where beacons stand: in parameters, or in states that are estimated."""

    def __init__(self, model: StateSpaceModel, names: Iterable[tuple[str, str]]) -> None:
        states, parameters = list(model.state_names), [parameter.name for parameter in model.parameters]
        self._found = [
            [(True, states.index(item)) if item in states else (False, parameters.index(item)) for item in pair]
            for pair in names
        ]

    def at(self, mean: np.ndarray, p: np.ndarray) -> np.ndarray:
        """East and north of each (k, 2), from states (nx,) and parameters (np,)."""
        return np.array([[mean[j] if state else p[j] for state, j in pair] for pair in self._found]).reshape(-1, 2)


class Beacons:
    """A diamond for each beacon, and a ring where it was heard lately."""

    def __init__(
        self, api: viser.SceneApi, name: str, model: StateSpaceModel, beacons: Mapping[str, tuple[str, str]],
        palette: Palette, *, size: float,
    ) -> None:  # fmt: skip
        self._palette = palette
        sensors = [sensor.name for sensor in model.sensors]
        self._sensors = [sensors.index(sensor) for sensor in beacons]
        self._places = BeaconPositions(model, beacons.values())
        self._marks = api.add_point_cloud(
            f"{name}/places", np.zeros((len(beacons), 3), np.float32), palette.ink, point_size=size,
            point_shape="diamond", precision="float32", point_shading="flat",
        )  # fmt: skip
        self._rings, self._texts = [], []
        for sensor in beacons:
            self._rings.append(
                api.add_line_segments(
                    f"{name}/{sensor}/ring", circle(SIDES), palette.reading, thickness=2, thickness_units="screen",
                    visible=False,
                )
            )  # fmt: skip
            text = sensor.replace("_", " ")
            self._texts.append(
                api.add_label(f"{name}/{sensor}/name", text, anchor="bottom-center", font_screen_scale=0.75)
            )
        self._size = size

    def draw(self, history: History, mean: np.ndarray, p: np.ndarray) -> None:
        """Send the positions of the beacons, and their recent ranges."""
        places = self._places.at(mean, p)
        points = np.column_stack((places, np.full(len(places), 0.2 * self._size))).astype(np.float32)
        if not np.array_equal(points, self._marks.points):
            self._marks.points = points
            for text, place in zip(self._texts, points, strict=True):
                text.position = place + [0.0, 0.6 * self._size, 0.0]
        t, kind, channel = (history.column(name) for name in ("t", "kind", "channel"))
        for ring, sensor, place in zip(self._rings, self._sensors, places, strict=True):
            mine = np.flatnonzero((kind == READING) & (channel == sensor))
            age = (t[-1] - t[mine[-1]]) / 1e9 if mine.size else np.inf
            far = float(history.column("value")[mine[-1], 0]) if mine.size else np.nan
            ring.visible = bool(age < FADING_S and far > 0)
            if ring.visible:
                refused = history.column("verdict")[mine[-1]] in (GATED, FAILED)
                color = self._palette.refused if refused else self._palette.reading
                color = mixed(color, self._palette.panel, 0.2 * round(4 * age / FADING_S))
                if tuple(ring.colors) != color:
                    ring.colors = np.array(color, np.uint8)
                ring.position, ring.scale = (*place, 0.03), (far, far, 1.0)


MAX_AGE_S = 3.0
"""Age in seconds from which a measurement is no longer drawn."""

HEIGHT = 0.12


class Beams:
    """Lines from the vehicle to the expected end of each beam, and dots at its measured end."""

    def __init__(
        self, api: viser.SceneApi, name: str, model: StateSpaceModel, angles: Mapping[str, Sequence[float]],
        palette: Palette, *, dot: float,
    ) -> None:  # fmt: skip
        self._model = model
        self._sensors = [k for k, sensor in enumerate(model.sensors) if sensor.name in angles]
        self._angles = [np.array(angles[model.sensors[k].name], float) for k in self._sensors]
        nothing, one = np.zeros((1, 2, 3), np.float32), np.zeros((1, 3), np.float32)
        line = {"thickness_units": "screen", "visible": False}
        self._expected = api.add_line_segments(f"{name}/expected", nothing, palette.estimate, thickness=1.5, **line)
        self._read = api.add_line_segments(f"{name}/read", nothing, palette.reading, thickness=1.5, **line)
        self._dots = [
            api.add_point_cloud(
                f"{name}/{kind}", one, color, point_size=dot, point_shape="circle", precision="float32",
                point_shading="flat", visible=False,
            )
            for kind, color in (("used", palette.reading), ("refused", palette.refused))
        ]  # fmt: skip

    def draw(self, history: History, mean: np.ndarray, place: np.ndarray, heading: float, p: np.ndarray) -> None:
        """Send the beams of a vehicle with state `mean` (nx,) at `place` (2,); p are the parameters."""
        expectations: list[tuple] = []
        readings: list[tuple] = []
        refusals: list[tuple] = []
        for k, angles in zip(self._sensors, self._angles, strict=True):
            should = expected(self._model, self._model.sensors[k], mean, p)
            read, refused = self._last(history, k, angles.size)
            for angle, far, seen in zip(angles, should, read, strict=True):
                way = np.array([np.cos(heading + angle), np.sin(heading + angle)])
                expectations.append((place, place + far * way))
                (refusals if refused else readings).append((place + far * way, place + seen * way))
        self._put(self._expected, np.array(expectations))
        self._put(self._read, np.array(readings + refusals))
        for handle, pairs in zip(self._dots, (readings, refusals), strict=True):
            ends = np.array([end for _, end in pairs]).reshape(-1, 2)
            ends = ends[np.isfinite(ends).all(axis=1)]
            handle.visible = bool(len(ends))
            if len(ends):
                handle.points = np.column_stack((ends, np.full(len(ends), HEIGHT + 0.05))).astype(np.float32)

    def hide(self) -> None:
        """Hide the beams while the position is unknown."""
        for handle in (self._expected, self._read, *self._dots):
            handle.visible = False

    @staticmethod
    def _last(history: History, sensor: int, rows: int) -> tuple[np.ndarray, bool]:
        """Return the newest measurement of a sensor (rows,), NaN if it is too old, and whether it was rejected."""
        mine = np.flatnonzero((history.column("kind") == READING) & (history.column("channel") == sensor))
        t = history.column("t")
        if not mine.size or t[-1] - t[mine[-1]] > MAX_AGE_S * 1e9:
            return np.full(rows, np.nan), False
        return history.column("value")[mine[-1], :rows], bool(history.column("verdict")[mine[-1]] in (GATED, FAILED))

    @staticmethod
    def _put(handle: viser.LineSegmentsHandle, pairs: np.ndarray) -> None:
        pairs = pairs.reshape(-1, 2, 2)
        pairs = pairs[np.isfinite(pairs).all(axis=(1, 2))]
        handle.visible = bool(len(pairs))
        if len(pairs):
            handle.points = np.concatenate((pairs, np.full((len(pairs), 2, 1), HEIGHT)), axis=2).astype(np.float32)
