"""A scale of colours with a line for each quantity on it: where its mean is, and how far ± 2σ reaches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser

from ...present.drawing.geometry import segments, with_deviation
from ...present.drawing.heatmap import ESTIMATE, NOTHING, Scale, gradient
from ...present.drawing.palette import RGB, Palette

TICKS = 9
ROW = 0.26
"""Height of a quantity's line and its text."""


class ScaleBar:
    """Stands upright, x from -1 to 1, its top at z = `top`, facing who looks north."""

    def __init__(
        self, api: viser.SceneApi, name: str, labels: Sequence[str], unit: str, theme: Palette, *, y: float, top: float
    ) -> None:
        self._labels, self._unit, self._y, self._top = labels, unit, y, top
        self._scale, self._colors = Scale(ESTIMATE), gradient(ESTIMATE.colors)
        strip = np.repeat(self._colors[:NOTHING][None], 8, axis=0)
        # An image lies in the plane of x and y, its top at -y: up it goes by a right angle about x.
        half = float(np.sqrt(0.5))
        api.add_image(
            f"{name}/strip", strip, 2.0, 0.09, format="png", wxyz=(half, -half, 0.0, 0.0),
            position=(0.0, y, top - 0.05), cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._ticks = [
            api.add_label(f"{name}/ticks/{k}", " ", anchor="top-center", font_screen_scale=0.75, visible=False)
            for k in range(TICKS)
        ]
        line = {"thickness_units": "screen"}
        nothing = np.zeros((1, 2, 3), np.float32)
        self._bands = api.add_line_segments(f"{name}/bands", nothing, theme.estimate, thickness=4, **line)
        self._means = api.add_line_segments(f"{name}/means", nothing, theme.ink, thickness=3, **line)
        self._texts = [
            api.add_label(f"{name}/text/{k}", label, position=(-1.0, y, self._row(k) + 0.05), anchor="bottom-left",
                          font_screen_scale=0.85)
            for k, label in enumerate(labels)
        ]  # fmt: skip
        self.bottom = self._row(len(labels) - 1) - 0.05

    def fit(self, mean: np.ndarray, std: np.ndarray) -> None:
        """Show these quantities; both (k,), NaN where one is not known."""
        self._scale.fit(np.concatenate((mean - 2 * std, mean + 2 * std)))
        for k, (label, place) in enumerate(zip(self._labels, zip(mean, std, strict=True), strict=True)):
            at, spread = place
            known = f"{label}  {with_deviation(at, 2 * spread)} {self._unit}"
            text = known if np.isfinite(at + spread) else f"{label}  –"
            if self._texts[k].text != text:
                self._texts[k].text = text
        ticks = self._scale.ticks()
        for label, tick in zip(self._ticks, [*ticks, *[None] * TICKS], strict=False):
            if label.visible != (tick is not None):
                label.visible = tick is not None
            if tick is not None and label.text != tick[1]:
                label.text = tick[1]
            if tick is not None:
                label.position = (2 * tick[0] - 1, self._y, self._top - 0.1)
        rows = np.array([self._row(k) for k in range(len(mean))])
        self._bands.points = self._lines(mean - 2 * std, mean + 2 * std, rows, rows)
        self._means.points = self._lines(mean, mean, rows - 0.04, rows + 0.04)

    def color(self, value: float) -> RGB:
        """The colour of a value; grey if it is not known."""
        red, green, blue = self._colors[self._scale.indices(np.array([value]))[0]]
        return int(red), int(green), int(blue)

    def _row(self, k: int) -> float:
        return self._top - 0.34 - ROW * (k + 1) + 0.06

    def _lines(self, start: np.ndarray, end: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Lines in the plane of the bar between values, at heights."""
        width = self._scale.high - self._scale.low
        gap = np.full(3, np.nan)
        points = []
        for a, b, c, d in zip(start, end, low, high, strict=True):
            x = np.clip((np.array([a, b]) - self._scale.low) / width, 0.0, 1.0) * 2 - 1
            points += [[x[0], self._y, c], [x[1], self._y, d], gap]
        return segments(np.array(points))
