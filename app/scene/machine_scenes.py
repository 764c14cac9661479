"""Scenes of machines: a motor cut open, cells of a battery, and a gripper before a part.

Motor: each part has the colours of its temperature, of the mean and of ± 2σ in alternating slices, so an uncertain part
is striped. Battery: cells are filled to their charge, in the colour of their temperature, with a slab for ± 2σ.
Gripper: the finger and its mirror image, with a pad in the colour of the contact's probability, and the part with ± 2σ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser

from estimators.log import truth_of
from estimators.model.state_space import StateSpaceModel

from ..charts.colors import ESTIMATE, RGB, UNKNOWN_INDEX, Palette, Scale, gradient, mixed, with_deviation
from ..engine.copies import Belief
from .field_scenes import draw_ticks
from .scene import History, Outlook, Shapes, about_z, put_points, segments, set_color, set_text

HEIGHT, RADIUS, PITCH = 1.4, 0.3, 0.78
CELLS_PER_ROW = 4
MIN_SLAB_HEIGHT = 0.004  # Smallest height of a slab


def _centred(root: viser.FrameHandle, reach: tuple[float, float], height: tuple[float, float], up: float) -> Outlook:
    """Move the middle of a machine to the origin, from where it reaches ± `reach` across and deep; return the view."""
    middle = np.array([0.0, 0.0, 0.5 * sum(height)])
    root.position = -middle
    across, deep = reach
    corners = np.array([[x, y, z] for x in (-across, across) for y in (-deep, deep) for z in height])
    return Outlook(corners - middle, np.array([0.0, -1.0, up]))


class BatteryScene:
    """Cells side by side, and below them the scale of their temperatures."""

    def __init__(
        self, api: viser.SceneApi, model: StateSpaceModel, charge: tuple[str, ...], temperature: tuple[str, ...],
        palette: Palette,
    ) -> None:  # fmt: skip
        names = model.state_names
        self._charge = [names.index(name) for name in charge]
        self._temperature = [names.index(name) for name in temperature]
        shapes = Shapes(api)
        self.root = shapes.frame()
        columns = min(CELLS_PER_ROW, len(charge))
        self._feet = np.array([
            [(k % columns - 0.5 * (columns - 1)) * PITCH, 0.0, -(k // columns) * (HEIGHT + 0.5)]
            for k in range(len(charge))
        ])  # fmt: skip
        self._fills, self._doubts, self._texts = [], [], []
        for k, foot in enumerate(self._feet):
            cell, at = shapes.below(f"cells/{k}"), {"position": foot + [0.0, 0.0, 0.5 * HEIGHT]}
            cell.body("cylinder", "can", RADIUS + 0.02, HEIGHT, palette.bound, opacity=0.16, **at)
            self._fills.append(cell.body("cylinder", "fill", RADIUS, 1.0, palette.previous, **at))
            self._doubts.append(cell.body("cylinder", "doubt", RADIUS + 0.03, 1.0, palette.estimate, opacity=0.4, **at))
            top = foot + [0.0, 0.0, HEIGHT + 0.08]
            self._texts.append(cell.label("text", scale=0.85, position=top, anchor="bottom-center"))
        low = float(self._feet[:, 2].min())
        self._bar = None
        if temperature:
            labels = [f"cell {k + 1}" for k in range(len(temperature))] if len(temperature) > 1 else ["temperature"]
            unit = model.states[self._temperature[0]].unit
            self._bar = ScaleBar(shapes.below("scale"), labels, unit, palette, y=0.0, top=low - 0.15)
            low = self._bar.bottom
        wide = max(1.05, 0.5 * columns * PITCH)
        self.outlook = _centred(self.root, (wide, 0.0), (low, HEIGHT + 0.3), 0.16)

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send charge and temperature of the cells."""
        if not heavy:
            return
        mean, std = belief.mean, np.sqrt(np.maximum(np.diag(belief.cov), 0.0))
        if self._bar is not None:
            self._bar.fit(mean[self._temperature], std[self._temperature])
            for fill, j in zip(self._fills, self._temperature, strict=True):
                set_color(fill, self._bar.color(mean[j]))
        for k, j in enumerate(self._charge):
            low, middle, high = (float(np.clip(mean[j] + s * std[j], 0.0, 1.0)) for s in (-2, 0, 2))
            known = bool(np.isfinite(mean[j]) and np.isfinite(std[j]))
            self._fills[k].visible = self._doubts[k].visible = known
            set_text(self._texts[k], f"{with_deviation(100 * mean[j], 200 * std[j])} %" if known else "–")
            if known:
                self._stand(self._fills[k], k, 0.0, middle)
                self._stand(self._doubts[k], k, low, high)

    def _stand(self, handle: viser.CylinderHandle, k: int, low: float, high: float) -> None:
        """Set the ends of a cylinder, as shares of a cell's height."""
        tall = max(HEIGHT * (high - low), MIN_SLAB_HEIGHT)
        handle.scale = (1.0, 1.0, tall)
        handle.position = self._feet[k] + [0.0, 0.0, HEIGHT * low + 0.5 * tall]


PART_WIDTH, HALF_DEPTH, HALF_HEIGHT = 30.0, 10.0, 12.0
"""Width of the part, and half of its depth and of its height, mm."""

FINGER, PAD = 7.0, 4.0  # Thickness of a finger and of its pad, mm

FINGER_TOP, PALM_HEIGHT = 34.0, 8.0
"""Upper end of the fingers above the middle of the part, and height of the palm, mm."""

FOLLOW_SHARE = 0.25
"""Share of the way to the estimate that the middle of the view moves in one frame."""


class GripperScene:
    """Finger on the left and part on the right; x is the way of the finger in mm."""

    def __init__(
        self, api: viser.SceneApi, model: StateSpaceModel, states: Mapping[Any, str], palette: Palette
    ) -> None:
        self._surface, self._depth, self._contact = (
            model.state_names.index(states[name]) for name in ("surface", "depth", "contact")
        )
        self._unit = model.states[self._depth].unit
        self._apart, self._touching = palette.previous, palette.estimate
        self.root = Shapes(api).frame()
        shapes = Shapes(api, "/scene/world")
        self.world = shapes.frame()
        steel, body = mixed(palette.faint, palette.panel, 0.25), mixed(palette.bound, palette.panel, 0.45)
        deep, tall = 1.4 * HALF_DEPTH, HALF_HEIGHT + 2.0 + FINGER_TOP
        self._part = shapes.body("box", "part", body, (PART_WIDTH, 2 * HALF_DEPTH, 2 * HALF_HEIGHT))
        self._fingers = [
            (
                shapes.body("box", f"fingers/{k}/steel", steel, (FINGER, deep, tall)),
                shapes.body("box", f"fingers/{k}/pad", self._apart, (1.0, deep, 2 * HALF_HEIGHT)),
            )
            for k in range(2)
        ]
        self._palm = shapes.body("box", "palm", steel, (1.0, deep, PALM_HEIGHT))
        size = (1.0, 2.3 * HALF_DEPTH, 2 * HALF_HEIGHT + 2.0)
        self._doubts = [
            shapes.body("box", f"doubt/{name}", palette.estimate, size, opacity=0.3) for name in ("surface", "finger")
        ]
        self._gap = shapes.lines("gap", palette.ink, 2)
        self._truth = shapes.lines("truth", palette.truth, 3)
        self._cloud = shapes.dots("cloud", palette.estimate, 0.35, visible=False)
        self._says = shapes.label("says", scale=0.9, anchor="bottom-center")
        self._between = shapes.label("between", scale=0.9, anchor="bottom-center")
        self._where = shapes.label("where", scale=0.9, anchor="top-center")
        # The gripper closes about the middle of the part, which is the middle of the view.
        prior = model.prior_mean
        self._middle = float(prior[self._surface]) + 0.5 * PART_WIDTH
        across = 0.5 * PART_WIDTH + abs(float(prior[self._depth])) + PAD + FINGER + 8.0
        low, high = -2.0 * HALF_HEIGHT, FINGER_TOP + PALM_HEIGHT + 8.0
        self._height = 0.5 * (low + high)
        self._look_at(self._middle)
        corners = np.array(
            [[x, y, z] for x in (-across, across) for y in (-HALF_DEPTH, HALF_DEPTH) for z in (low, high)]
        )
        self.outlook = Outlook(corners - [0.0, 0.0, self._height], np.array([-0.2, -1.0, 0.22]))

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send finger, part and contact; particles and truth only if `heavy`."""
        pick = [self._surface, self._depth]
        surface, depth = belief.mean[pick]
        contact = float(belief.mean[self._contact])
        known = bool(np.isfinite([surface, depth, contact]).all())
        bodies = [self._part, self._palm, *self._doubts, *(one for pair in self._fingers for one in pair)]
        for handle in (*bodies, self._says, self._between, self._where):
            handle.visible = known
        if not known:
            self._gap.visible = self._cloud.visible = self._truth.visible = False
            return
        contact = float(np.clip(contact, 0.0, 1.0))
        cov = belief.cov[np.ix_(pick, pick)]
        spread = 2 * np.sqrt(np.maximum([cov[0, 0], cov.sum(), cov[1, 1]], 0.0))
        self._look_at(self._middle + FOLLOW_SHARE * (float(surface) + 0.5 * PART_WIDTH - self._middle))
        self._part.position = (surface + 0.5 * PART_WIDTH, 0.0, 0.0)
        self._move_fingers(surface, depth, contact)
        for handle, at, around in zip(self._doubts, (surface, surface + depth), spread, strict=False):
            handle.position = (at, 0.0, 0.0)
            handle.scale = (max(2 * float(around), 0.02), 1.0, 1.0)
        self._measure(surface, depth, contact, spread)
        if heavy:
            self._draw_cloud(belief.points)
            self._draw_truth(history)

    def _move_fingers(self, surface: float, depth: float, contact: float) -> None:
        """Move the finger and its mirror image; a pad is compressed by the depth of the finger."""
        face = surface + depth - contact * max(depth, 0.0)
        back = surface + depth - PAD
        color = mixed(self._apart, self._touching, contact)
        tall = HALF_HEIGHT + 2.0 + FINGER_TOP
        for (steel, pad), mirrored in zip(self._fingers, (False, True), strict=True):
            ends = [2 * surface + PART_WIDTH - x if mirrored else x for x in (back - FINGER, back, face)]
            steel.position = (0.5 * (ends[0] + ends[1]), 0.0, FINGER_TOP - 0.5 * tall)
            pad.position = (0.5 * (ends[1] + ends[2]), 0.0, 0.0)
            pad.scale = (max(abs(ends[2] - ends[1]), 0.1), 1.0, 1.0)
            set_color(pad, color)
        self._palm.position = (surface + 0.5 * PART_WIDTH, 0.0, FINGER_TOP + 0.5 * PALM_HEIGHT)
        self._palm.scale = (PART_WIDTH + 2 * (surface - back + FINGER), 1.0, 1.0)

    def _measure(self, surface: float, depth: float, contact: float, spread: np.ndarray) -> None:
        """Draw the distance between finger and part as a line and as text."""
        height = HALF_HEIGHT + 4.0
        ends = np.array([surface + depth, surface])
        self._gap.visible = True
        self._gap.points = np.array(
            [[[ends[0], -HALF_DEPTH, height], [ends[1], -HALF_DEPTH, height]]]
            + [[[x, -HALF_DEPTH, height - 2.0], [x, -HALF_DEPTH, height + 2.0]] for x in ends],
            np.float32,
        )
        middle, unit = surface + 0.5 * PART_WIDTH, self._unit
        texts = (
            (self._between, f"depth {with_deviation(depth, spread[2])} {unit}", (min(ends), height + 2.5)),
            (self._says, f"contact {100 * contact:.0f} %", (middle, FINGER_TOP + PALM_HEIGHT + 2.0)),
            (self._where, f"part at {with_deviation(surface, spread[0])} {unit}", (middle, -HALF_HEIGHT - 5.0)),
        )
        for label, text, (x, z) in texts:
            set_text(label, text)
            label.position = (x, -HALF_DEPTH, z)

    def _draw_cloud(self, points: np.ndarray) -> None:
        """Draw the surface of the part by each particle."""
        at = points[:, self._surface] if len(points) else np.zeros(0)
        at = at[np.isfinite(at)]
        rows = np.linspace(-HALF_DEPTH, HALF_DEPTH, at.size)
        put_points(self._cloud, np.column_stack((at, rows, np.full(at.size, -HALF_HEIGHT - 2.0))))

    def _draw_truth(self, history: History) -> None:
        """Draw the true surface and finger."""
        events = history.events()
        known = [truth_of(events, j)[1] for j in (self._surface, self._depth)]
        surface, depth = (values[-1] if values.size else np.nan for values in known)
        lines = [
            [x, -1.15 * HALF_DEPTH, z]
            for x in (surface, surface + depth)
            for z in (-HALF_HEIGHT - 1.0, HALF_HEIGHT + 1.0)
        ]
        self._truth.visible = bool(np.isfinite(surface))
        self._truth.points = segments(np.insert(np.array(lines), 2, np.nan, axis=0))

    def _look_at(self, middle: float) -> None:
        """Move the world so that a position of the finger is in the middle of the view."""
        self._middle = middle
        self.world.position = (-middle, 0.0, -self._height)


SLOTS, MAGNETS = 12, 8
CUT_DEGREES = 90.0  # Angle that is cut out of the stator, degrees
AXIS_ANGLE = 0.3  # Angle between the axis and the view, radians

SIGMAS = (-2.0, 0.0, 2.0)

Sector = tuple[float, float, float, float, float]
"""Inner and outer radius, first and last angle in degrees, half the length."""


def sectors(part: str) -> list[Sector]:
    """Return the slices of a part of the motor, whose outer radius is 1 and whose axis is y."""
    pitch, pole = 360.0 / SLOTS, 360.0 / MAGNETS
    if part == "yoke":
        return [(0.78, 1.0, angle, angle + 10.0, 0.6) for angle in np.arange(CUT_DEGREES, 360.0, 10.0)]
    if part == "tooth":
        middles = pitch * np.arange(SLOTS) + 0.5 * pitch
        return [(0.52, 0.78, a - 6.0, a + 6.0, 0.6) for a in middles if a > CUT_DEGREES]
    if part == "winding":
        # Coils are longer than the iron: their ends stand out.
        middles = pitch * np.arange(SLOTS + 1)
        return [(0.55, 0.76, max(CUT_DEGREES, a - 8.0), min(360.0, a + 8.0), 0.78) for a in middles if a >= CUT_DEGREES]
    return [(0.36, 0.47, pole * k + 4.0, pole * (k + 1) - 4.0, 0.6) for k in range(MAGNETS)]


def mesh(parts: list[Sector]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and triangles (m, 3) of sectors of a ring about the y axis."""
    vertices, faces, count = [], [], 0
    for inner, outer, start, end, half in parts:
        angles = np.radians(np.linspace(start, end, max(2, int((end - start) / 4) + 1)))
        around = np.stack((np.cos(angles), np.zeros(angles.size), np.sin(angles)), axis=1)
        n, along = angles.size, np.array([0.0, half, 0.0])
        # Rings of points: inner front, outer front, outer back, inner back.
        vertices += [inner * around - along, outer * around - along, outer * around + along, inner * around + along]
        k = np.arange(n - 1)
        for ring in range(4):
            a, b = count + ring * n + k, count + (ring + 1) % 4 * n + k
            faces += [np.stack((a, b, b + 1), axis=1), np.stack((a, b + 1, a + 1), axis=1)]
        for side in (0, n - 1):
            corners = count + np.arange(4) * n + side
            faces.append(corners[[[0, 1, 2], [0, 2, 3]]])
        count += 4 * n
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.uint32)


class MotorScene:
    """Motor, and below it the scale of its colours with each part's temperature."""

    def __init__(self, api: viser.SceneApi, model: StateSpaceModel, parts: Mapping[Any, str], palette: Palette) -> None:
        self._states = [model.state_names.index(name) for name in parts.values()]
        shapes = Shapes(api)
        self.root = shapes.frame()
        motor = shapes.below("motor")
        motor.frame(wxyz=about_z(AXIS_ANGLE))
        style = {"color": mixed(palette.faint, palette.panel, 0.35), "side": "double", "flat_shading": True}
        motor.body("mesh_simple", "shaft", *mesh([(0.0, 0.13, 0.0, 360.0, 1.0)]), **style)
        motor.body("mesh_simple", "rotor", *mesh([(0.13, 0.36, 0.0, 360.0, 0.6)]), **style)
        for part in ("yoke", "tooth", "winding", "magnet"):
            if part not in parts:
                motor.body("mesh_simple", part, *mesh(sectors(part)), **style)
        self._parts = [
            [
                motor.body("mesh_simple", f"{part}/{k}", *mesh(sectors(part)[k :: len(SIGMAS)]), **style)
                for k in range(len(SIGMAS))
            ]
            for part in parts
        ]
        unit = model.states[self._states[0]].unit
        self._bar = ScaleBar(shapes.below("scale"), list(parts), unit, palette, y=-0.8, top=-1.15)
        self.outlook = _centred(self.root, (1.05, 0.8), (self._bar.bottom, 1.02), 0.28)

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send the present colours."""
        if not heavy:
            return
        mean = belief.mean[self._states]
        std = np.sqrt(np.maximum(belief.cov[self._states, self._states], 0.0))
        self._bar.fit(mean, std)
        for handles, at, spread in zip(self._parts, mean, std, strict=True):
            for handle, sigmas in zip(handles, SIGMAS, strict=True):
                set_color(handle, self._bar.color(at + sigmas * spread))


MAX_SCALE_TICKS = 9
ROW_HEIGHT = 0.26  # Height of the line of a quantity, with its text


class ScaleBar:
    """Upright scale of temperatures with its unit, x from -1 to 1, with mean and ± 2σ of each quantity below it."""

    def __init__(
        self, shapes: Shapes, labels: Sequence[str], unit: str, theme: Palette, *, y: float, top: float
    ) -> None:
        self._labels, self._unit, self._y, self._top = labels, unit, y, top
        self.title = shapes.label(
            "title", f"temperature [{unit}]", 0.85, position=(0.0, y, top - 0.24), anchor="top-center"
        )
        self._scale, self._colors = Scale(ESTIMATE), gradient(ESTIMATE.colors)
        strip = np.repeat(self._colors[:UNKNOWN_INDEX][None], 8, axis=0)
        # An image lies in the plane of x and y, its top at -y: up it goes by a right angle about x.
        half = float(np.sqrt(0.5))
        upright = {"wxyz": (half, -half, 0.0, 0.0), "position": (0.0, y, top - 0.05)}
        shapes.body("image", "strip", strip, 2.0, 0.09, format="png", **upright)
        self._ticks = [shapes.label(f"ticks/{k}", anchor="top-center", visible=False) for k in range(MAX_SCALE_TICKS)]
        self._bands = shapes.lines("bands", theme.estimate, 4)
        self._means = shapes.lines("means", theme.ink, 3)
        self._texts = [
            shapes.label(f"text/{k}", label, 0.85, position=(-1.0, y, self._row(k) + 0.05), anchor="bottom-left")
            for k, label in enumerate(labels)
        ]
        self.bottom = self._row(len(labels) - 1) - 0.05

    def fit(self, mean: np.ndarray, std: np.ndarray) -> None:
        """Show quantities; both (k,), NaN where one is unknown."""
        self._scale.fit(np.concatenate((mean - 2 * std, mean + 2 * std)))
        for text, label, at, spread in zip(self._texts, self._labels, mean, std, strict=True):
            known = np.isfinite(at + spread)
            set_text(text, f"{label}  {with_deviation(at, 2 * spread)} {self._unit}" if known else f"{label}  –")
        draw_ticks(self._ticks, self._scale, lambda share: (2 * share - 1, self._y, self._top - 0.1))
        rows = np.array([self._row(k) for k in range(len(mean))])
        self._bands.points = self._lines(mean - 2 * std, mean + 2 * std, rows, rows)
        self._means.points = self._lines(mean, mean, rows - 0.04, rows + 0.04)

    def color(self, value: float) -> RGB:
        """Return the colour of a value; grey if it is unknown."""
        red, green, blue = self._colors[self._scale.indices(np.array([value]))[0]]
        return int(red), int(green), int(blue)

    def _row(self, k: int) -> float:
        return self._top - 0.34 - ROW_HEIGHT * (k + 1) + 0.06

    def _lines(self, start: np.ndarray, end: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return lines between values at heights."""
        width = self._scale.high - self._scale.low
        gap = np.full(3, np.nan)
        points = []
        for a, b, c, d in zip(start, end, low, high, strict=True):
            x = np.clip((np.array([a, b]) - self._scale.low) / width, 0.0, 1.0) * 2 - 1
            points += [[x[0], self._y, c], [x[1], self._y, d], gap]
        return segments(np.array(points))
