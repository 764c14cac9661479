"""Scene of a twin that moves on a plane: vehicle, trail, walls, beams, beacons, measurements, truth, particles, 2σ.

The vehicle has its true size; a pointer of constant thickness shows it in a large place. With several peaks the vehicle
is at the heaviest one, and each has a dot with its weight: the mean between them is no likely position.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import viser

from estimators.log import READING, truth_of
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.peaks import Peak
from estimators.track import FAILED, GATED
from estimators.tuning import Tuning

from ..charts.colors import Palette, mixed, round_step
from ..charts.direct_readings import expected, observed
from ..engine.copies import Belief
from .scene import (
    History,
    Outlook,
    PeakMarks,
    Shapes,
    about_z,
    circle,
    disc,
    ellipsoid,
    on_circle,
    put_points,
    segments,
)

MAX_TRAIL_SPREAD = 20.0
"""Multiple of the median deviation above which a position is left out of the trail."""

MAX_TRAIL_STEP = 20.0
"""Multiple of the median step above which a step of the trail is drawn as a gap."""

TRAIL_POINTS = 300  # Largest number of points of a trail

MAX_PEAKS = 4
MAX_POSITION_DOTS = 600  # Largest number of position measurements of a sensor
FOLLOW_SHARE = 0.3  # Share of the way to the vehicle that the view moves in one frame

FOV = float(np.radians(40))
SLANTED = np.array([0.0, -0.68, 0.73])  # Direction from the vehicle to the initial camera

FROM_ABOVE = np.array([0.0, -0.12, 0.99])
"""Direction from walls to the initial camera, nearly from above: a corridor would otherwise be a line."""

FREE_RADIUS = 4.0  # Radius of the initial view without walls and beacons, in lengths of the vehicle

MIN_RADIUS = 0.7
"""Smallest radius of the initial view with walls or beacons, in lengths of the vehicle."""

BEACON_MARGIN = 1.2  # Factor by which the initial view reaches beyond the beacons, for their names

MAX_FILLED_ELLIPSE = 2.5
"""Multiple of the view's radius from which an ellipse is drawn as an outline only."""

MAX_FRAMES = 4096  # Frames that a trail of peaks keeps
FADING_S = 10.0  # Seconds over which the arc of a range pales; then it is gone
RANGE_ARC = 0.4  # Half of its angle, radians: whole rings are larger than the view, and hide the vehicle among them
MAX_AGE_S = 3.0  # Age in seconds from which the measurement of a beam is no longer drawn

ARC_SIDES = 40
BEAM_HEIGHT = 0.12


class VehicleScene:
    """The plane with east to the right and north up the screen, under a camera that the user turns freely.

    In a pane that is higher than wide, long walls have their east up. The view follows by moving the world under the
    camera, never the camera: a user's own turning and zooming is not disturbed, and coordinates near the camera stay
    small, which single precision needs.
    """

    def __init__(self, api: viser.SceneApi, model: StateSpaceModel, scene: Any, palette: Palette) -> None:
        names = model.state_names
        self._plane = [names.index(name) for name in scene.position]
        self._heading = names.index(scene.heading) if scene.heading else None
        dots = observed(model)
        self._fixes = [
            (dot.sensor, dot.row, other.row)
            for dot in dots
            for other in dots
            if dot.sensor == other.sensor and [dot.state, other.state] == self._plane
        ]
        self.tuning = Tuning.of(model)
        walled = np.array([corner for line in scene.walls for corner in line]).reshape(-1, 2)
        standing = np.concatenate((model.prior_mean, self.tuning.p))[beacon_entries(model, scene.beacons.values())]
        corners = np.concatenate((walled, standing))
        # With walls or beacons the view shows all of them: two peaks may be at opposite ends.
        self._home = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) if corners.size else None
        self._length = scene.size[0]
        self._reach = FREE_RADIUS * self._length
        if self._home is not None:
            self._reach = max(MIN_RADIUS * self._length, float(np.abs(corners - self._home).max()))
        dot_size = self._reach / 36.0
        self.follow = self._home is None
        self._anchor: np.ndarray | None = None if self._home is None else self._home.copy()
        self._course = 0.0
        self._known = False
        self.root = Shapes(api).frame()
        shapes = Shapes(api, "/scene/world")
        self.world = shapes.frame()
        cell = round_step(0.4 * self._reach)
        self._section = 5 * cell
        self._grid = api.add_grid(
            "/scene/grid", infinite_grid=True, cell_size=cell, section_size=self._section, fade_distance=90 * cell,
            cell_color=palette.grid, section_color=palette.rule, shadow_opacity=0.0,
        )  # fmt: skip
        self._trail, self._way = shapes.lines("trail", palette.estimate, 3), PeakTrail()
        self._truth = shapes.lines("truth", palette.truth, 2)
        self._readings = shapes.dots("readings", palette.reading, dot_size, visible=False)
        self._refused = shapes.dots("refused", palette.refused, dot_size, visible=False)
        style = {"color": palette.estimate, "opacity": 0.25, "side": "double"}
        self._ellipse = shapes.body("mesh_simple", "ellipse", *disc(), **style)
        self._rim = shapes.lines("rim", palette.estimate, 2, circle())
        walls = [segments(np.array([(*corner, 0.3) for corner in line])) for line in scene.walls]
        if walls:
            shapes.lines("walls", palette.faint, 3, np.concatenate(walls))
        self._cloud = shapes.dots("cloud", mixed(palette.estimate, palette.panel, 0.2), 0.3 * dot_size, visible=False)
        self._marks = PeakMarks(shapes, MAX_PEAKS, palette.estimate, 0.8 * dot_size)
        body = shapes.below("vehicle")
        self._vehicle = body.frame()
        add_body(body, scene.size, palette)
        pointer = np.array([[[0.0, 0.0, 0.02], [max(0.9 * self._length, 0.12 * self._reach), 0.0, 0.02]]], np.float32)
        body.lines("pointer", palette.estimate, 5, pointer)
        self._beams = self._beacons = None
        if scene.beams:
            self._beams = Beams(shapes.below("beams"), model, scene.beams, palette, dot=0.5 * dot_size)
        if scene.beacons:
            self._beacons = Beacons(shapes.below("beacons"), model, scene.beacons, palette, size=2 * dot_size)
        around = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        if self._home is None:
            self.outlook = Outlook(self._reach * around, SLANTED, fov=FOV)
        else:
            outline = np.column_stack((corners - self._home, np.zeros(len(corners))))
            outline[len(walled) :] *= BEACON_MARGIN
            points = np.vstack((outline, MIN_RADIUS * self._length * around))
            self.outlook = Outlook(points, FROM_ABOVE, fov=FOV, turns=True)
        self._move_world()

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send the present positions; lines, measurements and particles only if `heavy`."""
        if not history.n:
            return
        plane, t = history.column("mean")[:, self._plane], history.column("t")
        known = bool(np.isfinite(belief.mean[self._plane]).all())
        # Otherwise the earlier drawing would stay for an estimate that is not a number.
        heavy |= known != self._known
        self._known = known
        self._vehicle.visible = known
        several = belief.peaks if known and len(belief.peaks) > 1 else ()
        peak = several[0] if several else belief
        self._draw_peaks(several)
        self._way.update(t, plane, several[0].mean[self._plane] if several else None)
        if heavy:
            way = self._way.of(t, where_known(plane, history.column("std")[:, self._plane]))
            self._trail.points = segments(without_jumps(_line(way, 0.06)))
            self._draw_truth(history)
            self._draw_readings(history)
            cloud = belief.points[:, self._plane] if known and len(belief.points) else np.zeros((0, 2))
            put_points(self._cloud, _raised(cloud, 0.2))
            if self._beacons is not None:
                self._beacons.draw(history, belief.mean, peak.mean[self._plane], self.tuning.p)
        if known:
            self._draw_vehicle(plane, peak)
        else:
            self._draw_ellipse(np.zeros(2), np.full((2, 2), np.nan))
        if self._beams is not None and known:
            here = peak.mean[self._plane]
            self._beams.draw(history, peak.mean, here, self._course, self.tuning.p)
        elif self._beams is not None:
            self._beams.hide()

    def _draw_vehicle(self, plane: np.ndarray, peak: Peak | Belief) -> None:
        """Move the vehicle with its ellipse, and the world under the camera."""
        here = peak.mean[self._plane]
        middle = here if self.follow or self._home is None else self._home
        if self._anchor is None or np.linalg.norm(middle - self._anchor) > 200.0:
            self._anchor = middle.copy()
        self._anchor += FOLLOW_SHARE * (middle - self._anchor)
        self._move_world()
        if self._heading is not None:
            if np.isfinite(peak.mean[self._heading]):
                self._course = float(peak.mean[self._heading])
        else:
            step = plane[-1] - plane[max(0, len(plane) - 20)]
            if np.hypot(*step) > 0.2 * self._length:  # not so if one of the two is NaN
                self._course = float(np.arctan2(step[1], step[0]))
        self._vehicle.position = (*here, 0.0)
        self._vehicle.wxyz = about_z(self._course)
        self._draw_ellipse(here, peak.cov[np.ix_(self._plane, self._plane)])

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
        self._ellipse.visible = bool(axes[1] < MAX_FILLED_ELLIPSE * self._reach)
        for handle in (self._ellipse, self._rim):
            handle.position, handle.wxyz = (*here, 0.04), turn
            handle.scale = (float(axes[0]), float(axes[1]), 1.0)

    def _draw_truth(self, history: History) -> None:
        events = history.events()
        (in_east, east), (in_north, north) = (truth_of(events, j) for j in self._plane)
        times, of_east, of_north = np.intersect1d(events.t[in_east], events.t[in_north], return_indices=True)
        if times.size:
            self._truth.points = segments(_line(np.column_stack((east[of_east], north[of_north])), 0.05))

    def _draw_readings(self, history: History) -> None:
        kind, channel, value = (history.column(name) for name in ("kind", "channel", "value"))
        refused = np.isin(history.column("verdict"), (GATED, FAILED))
        for handle, wanted in ((self._readings, ~refused), (self._refused, refused)):
            parts = [np.zeros((0, 2))]
            for sensor, *rows in self._fixes:
                mine = np.flatnonzero((kind == READING) & (channel == sensor) & wanted)[-MAX_POSITION_DOTS:]
                parts.append(value[mine][:, rows])
            put_points(handle, _raised(np.concatenate(parts), 0.1))

    def _draw_peaks(self, peaks: Sequence[Peak]) -> None:
        # The vehicle and the end of its trail are at the heaviest.
        texts = [f"{100 * peak.weight:.0f} %{' drawn' if k == 0 else ''}" for k, peak in enumerate(peaks)]
        self._marks.draw([np.array([*peak.mean[self._plane], 1.2]) for peak in peaks], texts, (0.6, 0.6, 0.0))


def _raised(plane: np.ndarray, height: float) -> np.ndarray:
    return np.column_stack((plane, np.full(len(plane), height)))


def _line(plane: np.ndarray, height: float) -> np.ndarray:
    """Return positions (n, 2) at a height, evenly thinned to the points of a trail."""
    pick = np.unique(np.linspace(0, len(plane) - 1, min(len(plane), TRAIL_POINTS)).astype(int))
    return _raised(plane[pick], height)


def without_jumps(way: np.ndarray) -> np.ndarray:
    """Return a line (n, 3) with gaps at jumps: particles found the vehicle elsewhere, which did not drive there."""
    steps = np.hypot(*np.diff(way[:, :2], axis=0).T)
    moving = steps[steps > 0.0]
    leaps = np.flatnonzero(steps > MAX_TRAIL_STEP * np.median(moving)) if moving.size else moving.astype(int)
    return np.insert(way, leaps + 1, np.nan, axis=0)


def where_known(plane: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Return positions (n, 2), NaN where their deviations (n, 2) are far larger than usual, as those of a prior are."""
    spread = np.hypot(*std.T)
    limit = MAX_TRAIL_SPREAD * np.nanmedian(spread) if np.isfinite(spread).any() else None
    known = spread <= limit if limit is not None else np.ones(len(plane), bool)
    return np.where(known[:, None], plane, np.nan)


def add_body(shapes: Shapes, size: tuple[float, float, float], palette: Palette) -> None:
    """Add a body of that length, width and height, m, on the ground, its front along x: its cabin is pale."""
    long, wide, tall = size
    dark, pale = mixed(palette.estimate, palette.ink, 0.3), mixed(palette.estimate, palette.panel, 0.5)
    shapes.body("box", "body", dark, (long, wide, 0.5 * tall), position=(0, 0, 0.4 * tall))
    at = (-0.07 * long, 0, 0.825 * tall)
    shapes.body("box", "cabin", pale, (0.5 * long, 0.9 * wide, 0.35 * tall), position=at)


class PeakTrail:
    """Trail of an estimate with several peaks: the frames of one scene, each with the heaviest peak, or NaN.

    The track has the mean only, which lies between the peaks where the vehicle never was. Where frames had several
    peaks the trail follows the heaviest one; rows of the mean between two such frames are left out.
    """

    def __init__(self) -> None:
        self._looks: list[tuple[int, np.ndarray, np.ndarray]] = []

    def update(self, t: np.ndarray, mean: np.ndarray, peak: np.ndarray | None) -> None:
        """Keep the frame of the newest row.

        `t` has times of the rows, ns, (n,), `mean` the position by the mean of each, (n, 2). `peak` is that of the
        heaviest of several peaks, (2,); None if there is one.
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
        peaks = np.array([peak for *_, peak in self._looks]).reshape(-1, 2)
        several = np.isfinite(peaks[:, 0])
        if not several.any():
            return mean
        looks = np.array([then for then, *_ in self._looks])
        # The frame after each row; rows after the last frame are treated like it.
        led = np.minimum(np.searchsorted(looks, t), len(looks) - 1)
        kept = ~several[led]
        peaked = several & (looks >= t[0])
        times = np.concatenate((t[kept], looks[peaked]))
        return np.concatenate((mean[kept], peaks[peaked]))[np.argsort(times, kind="stable")]


def beacon_entries(model: StateSpaceModel, names: Iterable[tuple[str, str]]) -> np.ndarray:
    """Return where east and north of each beacon (k, 2) are among the states, estimated, and then the parameters."""
    known = [*model.state_names, *(parameter.name for parameter in model.parameters)]
    return np.array([[known.index(item) for item in pair] for pair in names], int).reshape(-1, 2)


class Beacons:
    """A diamond for each beacon, and an arc for its recent range, on the side of the vehicle."""

    def __init__(
        self, shapes: Shapes, model: StateSpaceModel, beacons: Mapping[str, tuple[str, str]], palette: Palette, *,
        size: float,
    ) -> None:  # fmt: skip
        self._palette, self._size = palette, size
        self._sensors = [model.sensor_names.index(sensor) for sensor in beacons]
        self._entries = beacon_entries(model, beacons.values())
        nowhere = np.zeros((len(beacons), 3), np.float32)
        self._marks = shapes.dots("places", palette.ink, size, nowhere, shape="diamond")
        line = segments(on_circle(np.linspace(-RANGE_ARC, RANGE_ARC, ARC_SIDES)))
        self._arcs = [shapes.lines(f"{sensor}/arc", palette.reading, 2, line, visible=False) for sensor in beacons]
        self._texts = [
            shapes.label(f"{sensor}/name", sensor.replace("_", " "), anchor="bottom-center") for sensor in beacons
        ]

    def draw(self, history: History, mean: np.ndarray, here: np.ndarray, p: np.ndarray) -> None:
        """Send the positions of the beacons, and their recent ranges towards the vehicle, which is `here` (2,)."""
        places = np.concatenate((mean, p))[self._entries]
        points = _raised(places, 0.2 * self._size).astype(np.float32)
        if not np.array_equal(points, self._marks.points):
            self._marks.points = points
            for text, place in zip(self._texts, points, strict=True):
                text.position = place + [0.0, 0.6 * self._size, 0.0]
        for arc, sensor, place in zip(self._arcs, self._sensors, places, strict=True):
            values, age, refused = last_reading(history, sensor)
            arc.visible = bool(age < FADING_S and values[0] > 0 and np.isfinite(here).all())
            if arc.visible:
                color = self._palette.refused if refused else self._palette.reading
                color = mixed(color, self._palette.panel, 0.2 * round(4 * age / FADING_S))
                if tuple(arc.colors) != color:
                    arc.colors = np.array(color, np.uint8)
                arc.position, arc.scale = (*place, 0.03), (values[0], values[0], 1.0)
                arc.wxyz = about_z(float(np.arctan2(*(here - place)[::-1])))


class Beams:
    """Lines from the vehicle to the expected end of each beam, and dots at its measured end."""

    def __init__(
        self, shapes: Shapes, model: StateSpaceModel, angles: Mapping[str, Sequence[float]], palette: Palette, *,
        dot: float,
    ) -> None:  # fmt: skip
        self._model = model
        self._sensors = [k for k, sensor in enumerate(model.sensors) if sensor.name in angles]
        self._angles = [np.array(angles[model.sensors[k].name], float) for k in self._sensors]
        self._expected = shapes.lines("expected", palette.estimate, 1.5, visible=False)
        self._read = shapes.lines("read", palette.reading, 1.5, visible=False)
        self._dots = [
            shapes.dots(kind, color, dot, visible=False)
            for kind, color in (("used", palette.reading), ("refused", palette.refused))
        ]

    def draw(self, history: History, mean: np.ndarray, place: np.ndarray, heading: float, p: np.ndarray) -> None:
        """Send the beams of a vehicle with state `mean` (nx,) at `place` (2,); p are the parameters."""
        expectations: list[np.ndarray] = []
        readings: dict[bool, list[np.ndarray]] = {False: [], True: []}
        for k, angles in zip(self._sensors, self._angles, strict=True):
            should = expected(self._model, self._model.sensors[k], mean, p)
            values, age, refused = last_reading(history, k)
            read = values[: angles.size] if age <= MAX_AGE_S else np.full(angles.size, np.nan)
            way = np.column_stack((np.cos(heading + angles), np.sin(heading + angles)))
            ends, seen = place + should[:, None] * way, place + read[:, None] * way
            expectations.append(np.stack((np.broadcast_to(place, ends.shape), ends), axis=1))
            readings[refused].append(np.stack((ends, seen), axis=1))
        nothing = [np.zeros((0, 2, 2))]
        put_points(self._expected, self._lifted(np.concatenate(nothing + expectations)))
        put_points(self._read, self._lifted(np.concatenate(nothing + readings[False] + readings[True])))
        for handle, refused in zip(self._dots, (False, True), strict=True):
            put_points(handle, _raised(np.concatenate(nothing + readings[refused])[:, 1], BEAM_HEIGHT + 0.05))

    @staticmethod
    def _lifted(pairs: np.ndarray) -> np.ndarray:
        return np.concatenate((pairs, np.full((len(pairs), 2, 1), BEAM_HEIGHT)), axis=2)

    def hide(self) -> None:
        """Hide the beams while the position is unknown."""
        for handle in (self._expected, self._read, *self._dots):
            handle.visible = False


def last_reading(history: History, sensor: int) -> tuple[np.ndarray, float, bool]:
    """Return the newest measurement of a sensor, its age in seconds, inf without one, and whether it was rejected."""
    t, value = history.column("t"), history.column("value")
    mine = np.flatnonzero((history.column("kind") == READING) & (history.column("channel") == sensor))
    if not mine.size:
        return np.full(value.shape[1], np.nan), np.inf, False
    k = mine[-1]
    return value[k], (t[-1] - t[k]) / 1e9, bool(history.column("verdict")[k] in (GATED, FAILED))
