"""A gripper's finger before the part that it feels for: what is between them, and whether they touch.

The finger stands where the estimate has it, with a pad that gives way as it presses, and in the colour of how probable
contact is. The part begins where it is believed to, give or take 2σ, and below it lie the particles' own opinions. The
finger on the far side is drawn as the mirror image of the other: the model knows of one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import viser

from estimators.log import truth_of
from estimators.model.state_space import StateSpaceModel

from ...live.outputs import Belief
from ...present.drawing.geometry import segments, with_deviation
from ...present.drawing.palette import Palette, mixed
from .camera import Outlook
from .history import History

PART, DEEP, TALL = 30.0, 10.0, 12.0
"""Width of the part, and half of its depth and of its height, mm."""

FINGER, PAD = 7.0, 4.0
"""Thickness of a finger and of its pad, mm."""

ABOVE, RISE = 34.0, 8.0
"""Where the fingers end, and the height of what carries them, mm above the part's middle."""

SHARE = 0.25
"""Part of the way to the estimate that the middle of the view moves in one frame."""


class GripperScene:
    """Across is the finger's way, in mm, from where it begins on the left to the part on the right."""

    def __init__(
        self, api: viser.SceneApi, model: StateSpaceModel, states: Mapping[str, str], palette: Palette
    ) -> None:
        self._surface, self._depth, self._contact = (
            model.state_names.index(states[name]) for name in ("surface", "depth", "contact")
        )
        self._unit = model.states[self._depth].unit
        self._apart, self._touching = palette.previous, palette.estimate
        self.root = api.add_frame("/scene", show_axes=False)
        self.world = api.add_frame("/scene/world", show_axes=False)
        flat = {"cast_shadow": False, "receive_shadow": False}
        line, world = {"thickness_units": "screen"}, "/scene/world"
        nothing = np.zeros((1, 2, 3), np.float32)
        steel, body = mixed(palette.faint, palette.panel, 0.25), mixed(palette.bound, palette.panel, 0.45)
        self._part = api.add_box(f"{world}/part", body, (PART, 2 * DEEP, 2 * TALL), **flat)
        tall = TALL + 2.0 + ABOVE
        self._fingers = [
            (
                api.add_box(f"{world}/fingers/{k}/steel", steel, (FINGER, 1.4 * DEEP, tall), **flat),
                api.add_box(f"{world}/fingers/{k}/pad", self._apart, (1.0, 1.4 * DEEP, 2 * TALL), **flat),
            )
            for k in range(2)
        ]
        self._palm = api.add_box(f"{world}/palm", steel, (1.0, 1.4 * DEEP, RISE), **flat)
        self._doubts = [
            api.add_box(
                f"{world}/doubt/{name}", palette.estimate, (1.0, 2.3 * DEEP, 2 * TALL + 2.0), opacity=0.3, **flat
            )
            for name in ("surface", "finger")
        ]
        self._gap = api.add_line_segments(f"{world}/gap", nothing, palette.ink, thickness=2, **line)
        self._truth = api.add_line_segments(f"{world}/truth", nothing, palette.truth, thickness=3, **line)
        self._cloud = api.add_point_cloud(
            f"{world}/cloud", np.zeros((1, 3), np.float32), palette.estimate, point_size=0.35, point_shape="circle",
            precision="float32", point_shading="flat", visible=False,
        )  # fmt: skip
        text = {"font_screen_scale": 0.9}
        self._says = api.add_label(f"{world}/says", " ", anchor="bottom-center", **text)
        self._between = api.add_label(f"{world}/between", " ", anchor="bottom-center", **text)
        self._where = api.add_label(f"{world}/where", " ", anchor="top-center", **text)
        # The gripper closes about the part's middle, which is where the view has its own.
        prior = model.prior_mean
        self._middle = float(prior[self._surface]) + 0.5 * PART
        across = 0.5 * PART + abs(float(prior[self._depth])) + PAD + FINGER + 8.0
        low, high = -2.0 * TALL, ABOVE + RISE + 8.0
        self._height = 0.5 * (low + high)
        self._look_at(self._middle)
        corners = np.array([[x, y, z] for x in (-across, across) for y in (-DEEP, DEEP) for z in (low, high)])
        self.outlook = Outlook(
            corners - [0.0, 0.0, self._height], np.array([-0.2, -1.0, 0.22]), np.array([0.0, 0.0, 1.0]),
            float(np.radians(20)),
        )  # fmt: skip

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send where finger and part are and whether they touch; particles and truth only if `heavy`."""
        pick = [self._surface, self._depth]
        surface, depth = belief.mean[pick]
        contact = float(belief.mean[self._contact])
        known = bool(np.isfinite([surface, depth, contact]).all())
        for handle in (self._part, self._palm, *self._doubts, *(one for pair in self._fingers for one in pair)):
            handle.visible = known
        for label in (self._says, self._between, self._where):
            label.visible = known
        if not known:
            self._gap.visible = self._cloud.visible = self._truth.visible = False
            return
        contact = float(np.clip(contact, 0.0, 1.0))
        cov = belief.cov[np.ix_(pick, pick)]
        spread = 2 * np.sqrt(np.maximum([cov[0, 0], cov.sum(), cov[1, 1]], 0.0))
        self._look_at(self._middle + SHARE * (float(surface) + 0.5 * PART - self._middle))
        self._part.position = (surface + 0.5 * PART, 0.0, 0.0)
        self._move_fingers(surface, depth, contact)
        for handle, at, around in zip(self._doubts, (surface, surface + depth), spread, strict=False):
            handle.position = (at, 0.0, 0.0)
            handle.scale = (max(2 * float(around), 0.02), 1.0, 1.0)
        self._measure(surface, depth, contact, spread)
        if heavy:
            self._draw_cloud(belief.points)
            self._draw_truth(history)

    def _move_fingers(self, surface: float, depth: float, contact: float) -> None:
        """The finger and its mirror image on the part's far side; a pad gives way by as much as the finger is deep."""
        face = surface + depth - contact * max(depth, 0.0)
        back = surface + depth - PAD
        color = mixed(self._apart, self._touching, contact)
        tall = TALL + 2.0 + ABOVE
        for (steel, pad), mirrored in zip(self._fingers, (False, True), strict=True):
            ends = [2 * surface + PART - x if mirrored else x for x in (back - FINGER, back, face)]
            steel.position = (0.5 * (ends[0] + ends[1]), 0.0, ABOVE - 0.5 * tall)
            pad.position = (0.5 * (ends[1] + ends[2]), 0.0, 0.0)
            pad.scale = (max(abs(ends[2] - ends[1]), 0.1), 1.0, 1.0)
            if tuple(pad.color) != color:
                pad.color = color
        self._palm.position = (surface + 0.5 * PART, 0.0, ABOVE + 0.5 * RISE)
        self._palm.scale = (PART + 2 * (surface - back + FINGER), 1.0, 1.0)

    def _measure(self, surface: float, depth: float, contact: float, spread: np.ndarray) -> None:
        """What is between finger and part, as a measure line, and in words."""
        height = TALL + 4.0
        ends = np.array([surface + depth, surface])
        self._gap.visible = True
        self._gap.points = np.array(
            [[[ends[0], -DEEP, height], [ends[1], -DEEP, height]]]
            + [[[x, -DEEP, height - 2.0], [x, -DEEP, height + 2.0]] for x in ends],
            np.float32,
        )
        middle, unit = surface + 0.5 * PART, self._unit
        texts = (
            (self._between, f"depth {with_deviation(depth, spread[2])} {unit}", (min(ends), height + 2.5)),
            (self._says, f"contact {100 * contact:.0f} %", (middle, ABOVE + RISE + 2.0)),
            (self._where, f"part at {with_deviation(surface, spread[0])} {unit}", (middle, -TALL - 5.0)),
        )
        for label, text, (x, z) in texts:
            if label.text != text:
                label.text = text
            label.position = (x, -DEEP, z)

    def _draw_cloud(self, points: np.ndarray) -> None:
        """Where the particles have the part begin."""
        at = points[:, self._surface] if len(points) else np.zeros(0)
        at = at[np.isfinite(at)]
        self._cloud.visible = bool(at.size)
        if at.size:
            rows = np.linspace(-DEEP, DEEP, at.size)
            self._cloud.points = np.column_stack((at, rows, np.full(at.size, -TALL - 2.0))).astype(np.float32)

    def _draw_truth(self, history: History) -> None:
        """Where the part begins and the finger is, in truth."""
        events = history.events()
        told = [truth_of(events, j)[1] for j in (self._surface, self._depth)]
        surface, depth = (values[-1] if values.size else np.nan for values in told)
        lines = [[x, -1.15 * DEEP, z] for x in (surface, surface + depth) for z in (-TALL - 1.0, TALL + 1.0)]
        self._truth.visible = bool(np.isfinite(surface))
        self._truth.points = segments(np.insert(np.array(lines), 2, np.nan, axis=0))

    def _look_at(self, middle: float) -> None:
        """Move the world so that a place on the finger's way is in the middle of the view."""
        self._middle = middle
        self.world.position = (-middle, 0.0, -self._height)
