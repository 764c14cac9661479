"""The belief plot: the estimate over up to three states, as a point in its 2σ ellipsoid, on axes with numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from estimators.log import truth_of
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.peaks import Peak

from ..drawing.geometry import circle, disc, ellipsoid, round_step, segments, tick_text
from ..engine.outputs import Belief
from .camera import fit_cameras
from .history import History

TRAIL = 120
"""Rows of the track that are drawn behind the point."""

TICKS = (-2, -1, 0, 1, 2)
PEAKS = 6
"""Peaks of the estimate that are marked at most."""

HALF = 2.5
"""Half an axis, in ticks."""


class _Axis:
    """One axis: its state, and the round numbers between which it runs."""

    def __init__(self, state: int) -> None:
        self.state = state
        self.step = 0.0
        self.middle = 0.0

    def fit(self, mean: float, reach: float) -> bool:
        """Move or rescale the axis if the belief no longer sits well in it; True if it changed.

        Only then: an axis that followed every step would make the point stand still and the numbers run.
        """
        reach = max(reach, 1e-12 + 1e-9 * abs(mean))
        half = HALF * self.step
        if self.step and 0.12 * half < reach < 0.85 * half and abs(mean - self.middle) + 0.5 * reach < half:
            return False
        self.step = round_step(reach * 2.2 / HALF)
        self.middle = round(mean / self.step) * self.step
        return True

    def place(self, values: np.ndarray) -> np.ndarray:
        """States as places between -1 and 1."""
        return (values - self.middle) / (HALF * self.step)


class BeliefScene:
    """Two states: a plane seen from above. Three: a box that the user turns."""

    def __init__(self, server: viser.ViserServer, model: StateSpaceModel, axes: tuple[str, ...] | None) -> None:
        self.model = model
        chosen = [model.state_names.index(name) for name in axes] if axes else list(range(min(3, model.nx)))
        self.axes = [_Axis(j) for j in chosen]
        self.flat = model.nx < 3
        self._stale = True
        api = server.scene
        api.set_up_direction("+z")
        line = {"thickness_units": "screen"}
        flat = self.flat
        ticks = np.array(TICKS) / HALF
        api.add_line_segments("/grid", _grid(ticks, flat), (214, 220, 230), thickness=1, **line)
        api.add_line_segments("/box", _frame(flat), (148, 163, 184), thickness=1.5, **line)
        self._labels = [
            [api.add_label(f"/ticks/{k}/{i}", " ", position=_beside(k, tick, 1.09, flat), anchor="center-center",
                           font_screen_scale=0.75) for i, tick in enumerate(ticks)]
            for k in range(2 if flat else 3)
        ]  # fmt: skip
        self._titles = [
            api.add_label(f"/titles/{k}", " ", position=_title_place(k, flat), font_screen_scale=0.9,
                          anchor="bottom-left" if flat and k else "center-center")
            for k in range(2 if flat else 3)
        ]  # fmt: skip
        nothing = np.zeros((1, 2, 3), np.float32)
        dot = {"point_shape": "circle", "precision": "float32", "point_shading": "flat"}
        one = np.zeros((1, 3), np.float32)
        # All that moves with the estimate hangs on one frame, so that no redraw shows half of a step.
        self._belief = api.add_frame("/belief", show_axes=False)
        self._trail = api.add_line_segments("/belief/trail", nothing, (120, 160, 240), thickness=2, **line)
        self._points = api.add_point_cloud("/belief/points", one, (124, 58, 237), point_size=0.03, visible=False, **dot)
        self._truth = api.add_point_cloud("/truth", one, (22, 163, 74), point_size=0.04, visible=False, **dot)
        self._mean = api.add_point_cloud(
            "/belief/mean", one + [0.0, 0.0, 0.04 if flat else 0.0], (29, 78, 216), point_size=0.04, **dot
        )
        self._peaks = [
            (
                api.add_point_cloud(f"/peaks/{k}/mean", one, (190, 24, 93), point_size=0.05, visible=False, **dot),
                api.add_label(f"/peaks/{k}/weight", " ", visible=False, font_screen_scale=0.8, anchor="bottom-left"),
            )
            for k in range(PEAKS)
        ]
        if flat:
            vertices, faces = disc()
            body = api.add_mesh_simple("/belief/ellipse/disc", vertices, faces, color=(96, 146, 246), opacity=0.25,
                                       side="double", cast_shadow=False, receive_shadow=False)  # fmt: skip
            rim = api.add_line_segments("/belief/ellipse/rim", circle(), (37, 99, 235), thickness=2, **line)
            self._bodies = [body, rim]
        else:
            shape = {"cast_shadow": False, "receive_shadow": False}
            body = api.add_icosphere("/belief/ellipse/body", 1.0, (96, 146, 246), opacity=0.28, subdivisions=4, **shape)
            wire = api.add_icosphere("/belief/ellipse/wire", 1.0, (59, 110, 220), wireframe=True, opacity=0.25,
                                     subdivisions=2, **shape)  # fmt: skip
            self._bodies = [body, wire]
        camera = server.initial_camera
        if flat:
            camera.position, camera.look_at, camera.up = (0.0, -0.01, 17.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)
            fit_cameras(server, float(np.radians(9.2)))
        else:
            camera.position, camera.look_at, camera.up = (3.6, -5.2, 3.4), (0.0, 0.0, -0.1), (0.0, 0.0, 1.0)
            fit_cameras(server, float(np.radians(33)))

    def controls(self, gui: viser.GuiApi) -> None:
        """A dropdown an axis, where there is a choice."""
        if self.model.nx < 3:
            return
        for k, axis in enumerate(self.axes):
            choice = gui.add_dropdown(
                f"Axis {'xyz'[k]}", self.model.state_names, initial_value=self.model.state_names[axis.state]
            )

            @choice.on_update
            def _(event: viser.GuiEvent, k: int = k, choice: Any = choice) -> None:
                # A whole new axis: the drawing thread sees either the old one or the new.
                self.axes[k] = _Axis(self.model.state_names.index(choice.value))

    def draw(self, history: History, belief: Belief) -> None:
        """Send where everything is now."""
        axes = list(self.axes)
        index = [axis.state for axis in axes]
        lift = np.array([0.0, 0.0, 0.02 if len(axes) < 3 else 0.0])
        mean, cov = belief.mean[index], belief.cov[np.ix_(index, index)]
        known = bool(np.isfinite(mean).all() and np.isfinite(cov).all())
        # What was drawn before would else stand for an estimate that is not a number.
        self._belief.visible = known
        if known:
            self._draw_belief(history, belief, axes, mean, cov, lift)
        self._mark(axes, index, belief.peaks if known else (), lift)
        self._cloud(self._truth, axes, self._true_point(history, index), lift)

    def _draw_belief(
        self, history: History, belief: Belief, axes: list[_Axis], mean: np.ndarray, cov: np.ndarray, lift: np.ndarray
    ) -> None:
        index = [axis.state for axis in axes]
        for k, axis in enumerate(axes):
            # A mode's axis always shows all of its values.
            last = 0.0 if axis.state != self.model.mode or self.model.jump is None else len(self.model.jump.modes) - 1.0
            middle, reach = (last / 2, 0.55 * last) if last else (mean[k], 2 * np.sqrt(max(cov[k, k], 0.0)))
            if axis.fit(float(middle), float(reach)):
                self._number(k, axis)
        scale = np.array([HALF * axis.step for axis in axes])
        full = np.zeros((3, 3))
        n = len(axes)
        full[:n, :n] = cov / np.outer(scale, scale)
        if n < 3:
            full[2, 2] = 2 * full.max() + 1.0  # the largest, so that the ellipse is the first two axes
        if n == 1:
            full[1, 1] = 1e-4
        half, turn = ellipsoid(full)
        centre = self._place(axes, mean[None])[0]
        self._belief.position = centre
        for handle in self._bodies:
            handle.wxyz = turn
            handle.scale = (float(half[0]), float(half[1]), float(half[2]) if n == 3 else 1.0)
        trail = self._place(axes, history.settled("mean", TRAIL)[:, index])
        trail[(np.abs(trail) > 1.0).any(axis=1)] = np.nan
        self._trail.points = segments(np.vstack((trail, centre)) - centre)
        self._cloud(
            self._points, axes, belief.points[:, index] if len(belief.points) else np.zeros((0, n)), lift, centre
        )

    def _mark(self, axes: list[_Axis], index: list[int], peaks: tuple[Peak, ...], lift: np.ndarray) -> None:
        """Put a dot with its weight at each peak, where there are several."""
        for k, (dot, label) in enumerate(self._peaks):
            place = self._place(axes, peaks[k].mean[None, index])[0] if k < len(peaks) else np.full(3, np.nan)
            shown = bool(np.isfinite(place).all() and (np.abs(place) <= 1.3).all())
            if shown:
                dot.points = (place + 2 * lift)[None].astype(np.float32)
                label.position = tuple(place + 2 * lift)
                label.text = f"{100 * peaks[k].weight:.0f} %"
            dot.visible = label.visible = shown

    def _cloud(
        self, handle: Any, axes: list[_Axis], states: np.ndarray, lift: np.ndarray, origin: np.ndarray | float = 0.0
    ) -> None:
        places = self._place(axes, states) + lift
        places = places[np.isfinite(places).all(axis=1) & (np.abs(places) <= 1.3).all(axis=1)]
        handle.visible = bool(len(places))
        if len(places):
            handle.points = places - origin

    def _true_point(self, history: History, index: list[int]) -> np.ndarray:
        events = history.events(slice(-4096, None))
        point = np.full((1, len(index)), np.nan)
        for k, j in enumerate(index):
            values = truth_of(events, j)[1]
            if values.size:
                point[0, k] = values[-1]
        return point

    def _place(self, axes: list[_Axis], states: np.ndarray) -> np.ndarray:
        out = np.zeros((len(states), 3))
        for k, axis in enumerate(axes):
            out[:, k] = axis.place(states[:, k])
        return out

    def _number(self, k: int, axis: _Axis) -> None:
        state = self.model.states[axis.state]
        unit = f" [{state.unit}]" if state.unit and state.unit != "1" else ""
        self._titles[k].text = f"{self.model.label(state.name)}{unit}"
        for tick, label in zip(TICKS, self._labels[k], strict=True):
            label.text = tick_text(axis.middle + tick * axis.step, axis.step)


def _beside(k: int, along: float, away: float, flat: bool) -> tuple[float, float, float]:
    """Where the numbers of axis k stand: beside the edge that the first view shows in front."""
    if flat:
        return ((along, -away, 0.0), (-away - 0.04, along, 0.0))[k]
    return ((along, -away, -1.06), (away, along, -1.06), (-away, -away, along))[k]


def _title_place(k: int, flat: bool) -> tuple[float, float, float]:
    if flat:
        return ((0.0, -1.22, 0.0), (-1.0, 1.04, 0.0))[k]
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
