"""Cells of a battery: filled as high as they are charged, in the colour of their temperature, the doubt as a slab."""

from __future__ import annotations

import numpy as np
import viser

from estimators.model.state_space import StateSpaceModel

from ...live.outputs import Belief
from ...present.drawing.palette import Palette
from .camera import Outlook
from .history import History
from .scale_bar import ScaleBar

HEIGHT, RADIUS, PITCH = 1.4, 0.3, 0.78
IN_A_ROW = 4
THINNEST = 0.004
"""Height of what would else be flat."""


class BatteryScene:
    """The cells side by side, and below them the scale of their temperatures."""

    def __init__(
        self, api: viser.SceneApi, model: StateSpaceModel, charge: tuple[str, ...], temperature: tuple[str, ...],
        palette: Palette,
    ) -> None:  # fmt: skip
        names = model.state_names
        self._charge = [names.index(name) for name in charge]
        self._temperature = [names.index(name) for name in temperature]
        self.root = api.add_frame("/scene", show_axes=False)
        flat = {"cast_shadow": False, "receive_shadow": False}
        columns = min(IN_A_ROW, len(charge))
        self._feet = np.array([
            [(k % columns - 0.5 * (columns - 1)) * PITCH, 0.0, -(k // columns) * (HEIGHT + 0.5)]
            for k in range(len(charge))
        ])  # fmt: skip
        self._fills, self._doubts, self._texts = [], [], []
        for k, foot in enumerate(self._feet):
            cell = f"/scene/cells/{k}"
            middle = foot + [0.0, 0.0, 0.5 * HEIGHT]
            api.add_cylinder(f"{cell}/can", RADIUS + 0.02, HEIGHT, palette.bound, opacity=0.16, position=middle, **flat)
            self._fills.append(api.add_cylinder(f"{cell}/fill", RADIUS, 1.0, palette.previous, position=middle, **flat))
            self._doubts.append(
                api.add_cylinder(f"{cell}/doubt", RADIUS + 0.03, 1.0, palette.estimate, opacity=0.4, position=middle,
                                 **flat)
            )  # fmt: skip
            self._texts.append(
                api.add_label(f"{cell}/text", " ", position=foot + [0.0, 0.0, HEIGHT + 0.08], anchor="bottom-center",
                              font_screen_scale=0.85)
            )  # fmt: skip
        low = float(self._feet[:, 2].min())
        self._bar = None
        if temperature:
            labels = [f"cell {k + 1}" for k in range(len(temperature))] if len(temperature) > 1 else ["temperature"]
            unit = model.states[self._temperature[0]].unit
            self._bar = ScaleBar(api, "/scene/scale", labels, unit, palette, y=0.0, top=low - 0.15)
            low = self._bar.bottom
        top, wide = HEIGHT + 0.3, max(1.05, 0.5 * columns * PITCH)
        middle = np.array([0.0, 0.0, 0.5 * (low + top)])
        corners = np.array([[x, 0.0, z] for x in (-wide, wide) for z in (low, top)])
        self.root.position = -middle
        self.outlook = Outlook(
            corners - middle, np.array([0.0, -1.0, 0.16]), np.array([0.0, 0.0, 1.0]), float(np.radians(20))
        )

    def draw(self, history: History, belief: Belief, heavy: bool = True) -> None:
        """Send how full and how warm the cells are now."""
        if not heavy:
            return
        mean, std = belief.mean, np.sqrt(np.maximum(np.diag(belief.cov), 0.0))
        if self._bar is not None:
            self._bar.fit(mean[self._temperature], std[self._temperature])
            for fill, j in zip(self._fills, self._temperature, strict=True):
                color = self._bar.color(mean[j])
                if tuple(fill.color) != color:
                    fill.color = color
        for k, j in enumerate(self._charge):
            low, middle, high = (float(np.clip(mean[j] + s * std[j], 0.0, 1.0)) for s in (-2, 0, 2))
            known = bool(np.isfinite(mean[j]) and np.isfinite(std[j]))
            self._fills[k].visible = self._doubts[k].visible = known
            text = f"{100 * mean[j]:.0f} ± {200 * std[j]:.0f} %" if known else "–"
            if self._texts[k].text != text:
                self._texts[k].text = text
            if known:
                self._stand(self._fills[k], k, 0.0, middle)
                self._stand(self._doubts[k], k, low, high)

    def _stand(self, handle: viser.CylinderHandle, k: int, low: float, high: float) -> None:
        """Let a cylinder reach from one share of a cell's height to another."""
        tall = max(HEIGHT * (high - low), THINNEST)
        handle.scale = (1.0, 1.0, tall)
        handle.position = self._feet[k] + [0.0, 0.0, HEIGHT * low + 0.5 * tall]
