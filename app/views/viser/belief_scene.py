"""Plot of the estimate over two or three states: ellipses or ellipsoids of 1σ and 2σ, particles, trail and truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from estimators.log import truth_of
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.peaks import Peak

from ...live.outputs import Belief
from ...present.drawing.colors import Palette, mixed, round_step, tick_text
from .scene import History, Outlook, circle, disc, ellipsoid, segments

TRAIL = 80
"""Rows of the track in the trail."""

TICKS = (-2, -1, 0, 1, 2)
PEAKS = 6
"""Largest number of marked peaks."""

HALF_AXIS_TICKS = 2.5
"""Half an axis, in ticks."""

SIZES = ((1, 0.022), (3, 0.036), (10, 0.06), (100, 0.1))
"""Number of equal particles, and size of their common point: heavier particles are larger."""

MAX_POSITION = 1.3
"""Position on an axis, which ends at 1, up to which points are drawn."""


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
        self.root = api.add_frame("/scene", show_axes=False)
        line = {"thickness_units": "screen"}
        ticks = np.array(TICKS) / HALF_AXIS_TICKS
        api.add_line_segments("/scene/grid", _grid(ticks, flat), palette.rule, thickness=1, **line)
        api.add_line_segments("/scene/box", _frame(flat), palette.bound, thickness=1.5, **line)
        shown = range(2 if flat else 3)
        self._labels = [
            [api.add_label(f"/scene/ticks/{k}/{i}", " ", position=_beside(k, tick, 1.09, flat), anchor="center-center",
                           font_screen_scale=0.75, visible=k < len(axes)) for i, tick in enumerate(ticks)]
            for k in shown
        ]  # fmt: skip
        self._titles = [
            api.add_label(f"/scene/titles/{k}", " ", position=_title_place(k, flat), font_screen_scale=0.9,
                          anchor="bottom-left" if k and (flat or k == 2) else "center-center", visible=k < len(axes))
            for k in shown
        ]  # fmt: skip
        one = np.zeros((1, 3), np.float32)
        dot = {"point_shape": "circle", "precision": "float32", "point_shading": "flat"}
        light = mixed(palette.estimate, palette.panel, 0.35)
        self._trail = api.add_line_segments("/scene/trail", np.zeros((1, 2, 3), np.float32), light, thickness=2, **line)
        self._clouds = [
            api.add_point_cloud(f"/scene/points/{k}", one, mixed(palette.estimate, palette.panel, 0.2), point_size=size,
                                visible=False, point_shape="circle", point_shading="flat")
            for k, (_, size) in enumerate(SIZES)
        ]  # fmt: skip
        self._truth = api.add_point_cloud("/scene/truth", one, palette.truth, point_size=0.05, visible=False,
                                          **dot | {"point_shape": "diamond"})  # fmt: skip
        self._belief = api.add_frame("/scene/belief", show_axes=False)
        self._mean = api.add_point_cloud(
            "/scene/belief/mean", one + [0.0, 0.0, 0.04 if flat else 0.0], palette.estimate, point_size=0.04, **dot
        )
        self._peaks = [
            (
                api.add_point_cloud(
                    f"/scene/peaks/{k}/mean", one, palette.estimate, point_size=0.05, visible=False, **dot
                ),
                api.add_label(f"/scene/peaks/{k}/weight", " ", visible=False, font_screen_scale=0.8,
                              anchor="bottom-left"),
            )
            for k in range(PEAKS)
        ]  # fmt: skip
        self._bodies = [self._body(api, sigmas, palette, line) for sigmas in (1, 2)]
        margin = np.array([[-1.3, -1.32, 0.0], [1.12, -1.32, 0.0], [-1.3, 1.22, 0.0], [1.12, 1.22, 0.0]])
        if flat:
            self.outlook = Outlook.from_above(margin)
        else:
            box = np.stack(np.meshgrid([-1.15, 1.15], [-1.15, 1.15], [-1.1, 1.15]), axis=-1).reshape(-1, 3)
            titles = np.array([_title_place(k, False) for k in range(3)])
            self.outlook = Outlook(
                np.vstack((box, titles)), np.array([3.6, -5.2, 3.4]), np.array([0.0, 0.0, 1.0]), np.radians(33)
            )

    def _body(self, api: viser.SceneApi, sigmas: int, palette: Palette, line: dict[str, Any]) -> tuple[int, list[Any]]:
        """Return the handles of the ellipse or ellipsoid of a number of σ, with that number."""
        name, flat = f"/scene/belief/{sigmas}", {"cast_shadow": False, "receive_shadow": False}
        opacity = {1: 0.28, 2: 0.16}[sigmas]
        if not self.flat:
            body = api.add_icosphere(f"{name}/body", 1.0, palette.estimate, opacity=opacity, subdivisions=4, **flat)
            return sigmas, [body]
        vertices, faces = disc()
        plate = api.add_mesh_simple(
            f"{name}/disc", vertices, faces, color=palette.estimate, opacity=opacity, side="double", **flat
        )
        rim = api.add_line_segments(f"{name}/rim", circle(), palette.estimate, thickness=3.0 - sigmas, **line)
        return sigmas, [plate, rim]

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send the present estimate; trail and particles only if `heavy`."""
        axes, index = self.axes, [axis.state for axis in self.axes]
        lift = np.array([0.0, 0.0, 0.02 if self.flat else 0.0])
        mean, cov = belief.mean[index], belief.cov[np.ix_(index, index)]
        known = bool(np.isfinite(mean).all() and np.isfinite(cov).all())
        # Otherwise the earlier drawing would stay for an estimate that is not a number.
        heavy |= known != self._known
        self._known = known
        self._belief.visible = known
        if known:
            heavy |= self._draw_belief(mean, cov)
        self._mark(index, belief.peaks if known else (), lift)
        self._truth.visible = self._put(self._truth, self._true_point(history, index), lift)
        if heavy:
            self._draw_points(belief.points[:, index] if known and len(belief.points) else np.zeros((0, len(axes))))
            trail = self._place(history.settled("mean", TRAIL)[:, self._columns(index)])
            trail[(np.abs(trail) > 1.0).any(axis=1)] = np.nan
            self._trail.points = segments(trail)

    def _columns(self, index: list[int]) -> list[int]:
        """Return the columns of these states in the track."""
        return [int(np.searchsorted(self.model.shown, j)) for j in index]

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
        bounds = [size for size, _ in SIZES] + [np.inf]
        for k, handle in enumerate(self._clouds):
            handle.visible = self._put(handle, points[(counts >= bounds[k]) & (counts < bounds[k + 1])], 0.02)

    def _mark(self, index: list[int], peaks: tuple[Peak, ...], lift: np.ndarray) -> None:
        """Draw a dot with its weight at each of several peaks."""
        for k, (dot, label) in enumerate(self._peaks):
            place = self._place(peaks[k].mean[None, index])[0] if k < len(peaks) else np.full(3, np.nan)
            shown = bool(np.isfinite(place).all() and (np.abs(place) <= MAX_POSITION).all())
            if shown:
                dot.points = (place + 2 * lift)[None].astype(np.float32)
                label.position = tuple(place + 2 * lift + [0.04, 0.04, 0.0])
                label.text = f"{100 * peaks[k].weight:.0f} %"
            dot.visible = label.visible = shown

    def _put(self, handle: Any, states: np.ndarray, lift: np.ndarray | float) -> bool:
        """Draw states as points; return whether any is in view."""
        places = self._place(states)
        places[:, 2] += np.max(lift) if self.flat else 0.0
        places = places[np.isfinite(places).all(axis=1) & (np.abs(places) <= MAX_POSITION).all(axis=1)]
        if len(places):
            handle.points = places
        return bool(len(places))

    def _true_point(self, history: History, index: list[int]) -> np.ndarray:
        events = history.events(slice(-4096, None))
        point = np.full((1, len(index)), np.nan)
        for k, j in enumerate(index):
            values = truth_of(events, j)[1]
            if values.size:
                point[0, k] = values[-1]
        return point

    def _place(self, states: np.ndarray) -> np.ndarray:
        out = np.zeros((len(states), 3))
        for k, axis in enumerate(self.axes):
            out[:, k] = axis.place(states[:, k]) if axis.step else np.nan
        return out

    def _number(self, k: int, axis: _Axis) -> None:
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
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], float)
    bottom = segments(np.column_stack((square, np.full(5, 0.0 if flat else -1.0))))
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
