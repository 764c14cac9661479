"""Plot of the estimate over up to three states: ellipses or ellipsoids of 1σ and 2σ, particles, trail and truth."""

from __future__ import annotations

import numpy as np
import viser

from estimators.log import truth_of
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.peaks import Peak

from ..charts.colors import Palette, mixed, round_step, tick_text
from ..engine.copies import Belief
from .scene import SQUARE, History, Outlook, PeakMarks, Shapes, circle, disc, ellipsoid, segments

TRAIL_ROWS = 80  # Rows of the track in the trail

TICKS = (-2, -1, 0, 1, 2)
MAX_PEAKS = 6  # Largest number of marked peaks
HALF_AXIS_TICKS = 2.5  # Half an axis, in ticks

PARTICLE_SIZES = ((1, 0.022), (3, 0.036), (10, 0.06), (100, 0.1))
"""Number of equal particles, and size of their common point: heavier particles are larger."""

MAX_POSITION = 1.3  # Position on an axis, which ends at 1, up to which points are drawn


class _Axis:
    """Axis of a state, with round numbers as ticks."""

    def __init__(self, state: int) -> None:
        self.state = state
        self.step = 0.0
        self.middle = 0.0

    def fit(self, mean: float, reach: float) -> bool:
        """Move or rescale the axis if the estimate no longer fits; return whether it changed.

        An axis that followed every step would keep the point still and move the numbers.
        """
        reach = max(reach, 1e-12 + 1e-9 * abs(mean))
        half = HALF_AXIS_TICKS * self.step
        if self.step and 0.12 * half < reach < 0.85 * half and abs(mean - self.middle) + 0.5 * reach < half:
            return False
        self.step = round_step(reach * 2.2 / HALF_AXIS_TICKS)
        self.middle = round(mean / self.step) * self.step
        return True

    def place(self, values: np.ndarray) -> np.ndarray:
        """Return states as positions between -1 and 1."""
        return (values - self.middle) / (HALF_AXIS_TICKS * self.step)


class BeliefScene:
    """Up to two states: a plane seen from above. Three: a box that the user turns."""

    def __init__(self, api: viser.SceneApi, model: StateSpaceModel, axes: list[int], palette: Palette) -> None:
        self.model = model
        self.axes = [_Axis(j) for j in axes]
        self.flat = flat = len(axes) < 3
        self._known = False
        shapes = Shapes(api)
        self.root = shapes.frame()
        ticks = np.array(TICKS) / HALF_AXIS_TICKS
        shapes.lines("grid", palette.rule, 1, _grid(ticks, flat))
        shapes.lines("box", palette.bound, 1.5, _frame(flat))
        self._labels = [
            [
                shapes.label(f"ticks/{k}/{i}", position=_beside(k, tick, 1.09, flat), anchor="center-center")
                for i, tick in enumerate(ticks)
            ]
            for k in range(len(axes))
        ]
        self._titles = [
            shapes.label(
                f"titles/{k}", scale=0.9, position=_title_place(k, flat),
                anchor="bottom-left" if k and (flat or k == 2) else "center-center",
            )
            for k in range(len(axes))
        ]  # fmt: skip
        self._trail = shapes.lines("trail", mixed(palette.estimate, palette.panel, 0.35), 2)
        light = mixed(palette.estimate, palette.panel, 0.2)
        self._clouds = [
            shapes.dots(f"points/{k}", light, size, visible=False, precision="float16")
            for k, (_, size) in enumerate(PARTICLE_SIZES)
        ]
        self._truth = shapes.dots("truth", palette.truth, 0.05, shape="diamond", visible=False)
        below = shapes.below("belief")
        self._belief = below.frame()
        below.dots("mean", palette.estimate, 0.04, np.array([[0.0, 0.0, 0.04 if flat else 0.0]], np.float32))
        self._marks = PeakMarks(shapes, MAX_PEAKS, palette.estimate, 0.05, scale=0.8)
        self._bodies = [(sigmas, self._body(below, sigmas, palette)) for sigmas in (1, 2)]
        margin = np.array([[-1.3, -1.32, 0.0], [1.12, -1.32, 0.0], [-1.3, 1.22, 0.0], [1.12, 1.22, 0.0]])
        if flat:
            self.outlook = Outlook.from_above(margin)
        else:
            box = np.stack(np.meshgrid([-1.15, 1.15], [-1.15, 1.15], [-1.1, 1.15]), axis=-1).reshape(-1, 3)
            titles = np.array([_title_place(k, False) for k in range(3)])
            self.outlook = Outlook(np.vstack((box, titles)), np.array([3.6, -5.2, 3.4]), fov=float(np.radians(33)))

    def _body(self, shapes: Shapes, sigmas: int, palette: Palette) -> list[viser.SceneNodeHandle]:
        """Return the handles of the ellipse or ellipsoid of a number of σ."""
        style = {"color": palette.estimate, "opacity": {1: 0.28, 2: 0.16}[sigmas]}
        if not self.flat:
            return [shapes.body("icosphere", f"{sigmas}/body", 1.0, subdivisions=4, **style)]
        plate = shapes.body("mesh_simple", f"{sigmas}/disc", *disc(), side="double", **style)
        return [plate, shapes.lines(f"{sigmas}/rim", palette.estimate, 3.0 - sigmas, circle())]

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send the present estimate; trail and particles only if `heavy`."""
        index = [axis.state for axis in self.axes]
        mean, cov = belief.mean[index], belief.cov[np.ix_(index, index)]
        known = bool(np.isfinite(mean).all() and np.isfinite(cov).all())
        # Otherwise the earlier drawing would stay for an estimate that is not a number.
        heavy |= known != self._known
        self._known = known
        self._belief.visible = known
        if known:
            heavy |= self._draw_belief(mean, cov)
        self._draw_peaks(index, belief.peaks if known else ())
        self._put(self._truth, self._true_point(history, index))
        if heavy:
            self._draw_points(belief.points[:, index] if known and len(belief.points) else np.zeros((0, len(index))))
            columns = [int(np.searchsorted(self.model.shown, j)) for j in index]
            trail = self._place(history.settled("mean", TRAIL_ROWS)[:, columns])
            trail[(np.abs(trail) > 1.0).any(axis=1)] = np.nan
            self._trail.points = segments(trail)

    def _draw_belief(self, mean: np.ndarray, cov: np.ndarray) -> bool:
        """Move the ellipses; return whether an axis changed, which moves everything else."""
        changed = False
        for k, axis in enumerate(self.axes):
            # A mode's axis always shows all of its values.
            last = 0.0 if axis.state != self.model.mode or self.model.jump is None else len(self.model.jump.modes) - 1.0
            middle, reach = (last / 2, 0.55 * last) if last else (mean[k], 2 * np.sqrt(max(cov[k, k], 0.0)))
            if axis.fit(float(middle), float(reach)):
                self._number(k, axis)
                changed = True
        scale = np.array([HALF_AXIS_TICKS * axis.step for axis in self.axes])
        full, n = np.zeros((3, 3)), len(self.axes)
        full[:n, :n] = cov / np.outer(scale, scale)
        if n < 3:
            full[2, 2] = 2 * full.max() + 1.0  # the largest, so that the ellipse is the first two axes
        if n == 1:
            full[1, 1] = 1e-4
        self._belief.position = self._place(mean[None])[0]
        for sigmas, handles in self._bodies:
            half, turn = ellipsoid(full, sigmas)
            for handle in handles:
                handle.wxyz = turn
                handle.scale = (float(half[0]), float(half[1]), float(half[2]) if n == 3 else 1.0)
        return changed

    def _draw_points(self, states: np.ndarray) -> None:
        """Draw the particles; equal ones as one point, larger for a larger number."""
        points, counts = np.unique(states, axis=0, return_counts=True)
        bounds = [size for size, _ in PARTICLE_SIZES] + [np.inf]
        for k, handle in enumerate(self._clouds):
            self._put(handle, points[(counts >= bounds[k]) & (counts < bounds[k + 1])])

    def _draw_peaks(self, index: list[int], peaks: tuple[Peak, ...]) -> None:
        lift = 0.04 if self.flat else 0.0
        places = self._place(np.array([peak.mean[index] for peak in peaks]).reshape(-1, len(index)))
        places[(np.abs(places) > MAX_POSITION).any(axis=1)] = np.nan
        texts = [f"{100 * peak.weight:.0f} %" for peak in peaks]
        self._marks.draw(list(places + [0.0, 0.0, lift]), texts, (0.04, 0.04, 0.0))

    def _put(self, handle: viser.PointCloudHandle, states: np.ndarray) -> None:
        """Draw the states that are in view as points."""
        places = self._place(states)
        places[:, 2] += 0.02 if self.flat else 0.0
        places = places[np.isfinite(places).all(axis=1) & (np.abs(places) <= MAX_POSITION).all(axis=1)]
        if len(places):
            handle.points = places
        handle.visible = bool(len(places))

    def _true_point(self, history: History, index: list[int]) -> np.ndarray:
        """Return the last true values of the states, (1, k); NaN where one is not known."""
        events = history.events(slice(-4096, None))
        known = [truth_of(events, j)[1] for j in index]
        return np.array([[values[-1] if values.size else np.nan for values in known]])

    def _place(self, states: np.ndarray) -> np.ndarray:
        """Return states (n, k) as positions (n, 3), NaN on an axis without a scale."""
        out = np.zeros((len(states), 3))
        for k, axis in enumerate(self.axes):
            out[:, k] = axis.place(states[:, k]) if axis.step else np.nan
        return out

    def _number(self, k: int, axis: _Axis) -> None:
        """Set title and numbers of an axis."""
        state = self.model.states[axis.state]
        unit = f" [{state.unit}]" if state.unit and state.unit != "1" else ""
        self._titles[k].text = f"{self.model.label(state.name).replace('_', ' ')}{unit}"
        for tick, label in zip(TICKS, self._labels[k], strict=True):
            label.text = tick_text(axis.middle + tick * axis.step, axis.step)


def _beside(k: int, along: float, away: float, flat: bool) -> tuple[float, float, float]:
    """Return the position of the numbers of axis k, beside the front edge of the initial view."""
    if flat:
        return ((along, -away, 0.0), (-away - 0.04, along, 0.0))[k]
    return ((along, -away, -1.06), (away, along, -1.06), (-away, -away, along))[k]


def _title_place(k: int, flat: bool) -> tuple[float, float, float]:
    if flat:
        return ((0.0, -1.24, 0.0), (-1.0, 1.04, 0.0))[k]
    return _beside(k, 0.0, (1.38, 1.62)[k], flat) if k < 2 else (-1.0, -1.0, 1.16)


def _frame(flat: bool) -> np.ndarray:
    bottom = segments(np.column_stack((SQUARE, np.full(5, 0.0 if flat else -1.0))))
    if flat:
        return bottom
    up = [[[x, y, -1], [x, y, 1]] for x, y in ((-1, -1), (-1, 1), (1, 1))]
    back = [[[-1, -1, 1], [-1, 1, 1]], [[-1, 1, 1], [1, 1, 1]]]
    return np.concatenate((bottom, np.array(up + back, np.float32)))


def _grid(ticks: np.ndarray, flat: bool) -> np.ndarray:
    z = -0.001 if flat else -1.0
    lines = []
    for tick in ticks:
        lines += [[[tick, -1, z], [tick, 1, z]], [[-1, tick, z], [1, tick, z]]]
        if not flat:
            lines += [[[tick, 1, -1], [tick, 1, 1]], [[-1, 1, tick], [1, 1, tick]]]
            lines += [[[-1, tick, -1], [-1, tick, 1]], [[-1, -1, tick], [-1, 1, tick]]]
    return np.array(lines, np.float32)
