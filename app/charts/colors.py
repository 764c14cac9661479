"""Colours of the page for Viser's scenes and Rerun's charts: one meaning each, in light and in dark.

The page's style sheet defines them, so that users who see no red or no green can distinguish them (after Okabe and Ito,
2008).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.field_pictures import Picture, plane_shape, reduction
from estimators.log import Events
from estimators.model.parts import Field
from estimators.model.state_space import StateSpaceModel
from estimators.track import HEALTH_NAMES, Track

RGB = tuple[int, int, int]

PAGE = Path(__file__).resolve().parents[1] / "web" / "page"
"""The page's files, as installed beside this package."""


def rgb(color: str) -> RGB:
    """Return `#rrggbb` as three numbers from 0 to 255."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def mixed(a: RGB, b: RGB, share: float) -> RGB:
    """Return a mixture of two colours with `share` of the second."""
    x, y, z = (round(p + share * (q - p)) for p, q in zip(a, b, strict=True))
    return x, y, z


@dataclass(frozen=True)
class Palette:
    """One theme; `health` is by the names of `HEALTH_NAMES`."""

    panel: RGB
    ink: RGB
    faint: RGB
    rule: RGB
    grid: RGB
    estimate: RGB
    truth: RGB
    reading: RGB
    refused: RGB
    previous: RGB
    bound: RGB
    smoothed: RGB
    health: dict[str, RGB] = field(hash=False)


def _palette(selector: str) -> Palette:
    """Return the colours that a rule of the page's style sheet sets."""
    rule = (PAGE / "chart.css").read_text().partition(f"{selector} {{")[2].partition("\n}")[0]
    found = {name: rgb(color) for name, color in re.findall(r"--([\w-]+): (#[0-9a-f]{6});", rule)}
    names = [item.name for item in fields(Palette) if item.name != "health"]
    return Palette(
        **{name: found[name] for name in names}, health={name: found[f"health-{name}"] for name in HEALTH_NAMES}
    )


LIGHT, DARK = _palette(":root"), _palette(':root[data-theme="dark"]')
THEMES = {"light": LIGHT, "dark": DARK}

EITHER = Palette(
    **{
        item.name: mixed(getattr(LIGHT, item.name), getattr(DARK, item.name), 0.5)
        for item in fields(Palette)
        if item.name != "health"
    },
    health={name: mixed(color, DARK.health[name], 0.5) for name, color in LIGHT.health.items()},
)
"""For files, whose viewer may be light or dark."""


WARM = ("#0b1354", "#3b2e8c", "#7b2f8d", "#b73779", "#e8604c", "#f9a03f", "#fcf3a6")
"""From low to high values of a quantity."""

SPREAD = ("#f7fbff", "#c6dbef", "#6baed6", "#2171b5", "#08306b")
"""From zero to large values."""

SIGNED = ("#1d4ed8", "#7aa2f0", "#f5f5f5", "#f2a07a", "#b91c1c")
"""From negative over zero to positive values."""

UNKNOWN_INDEX = 255
"""Index of the colour of unknown values, grey."""

NORMAL_DOT, LARGE_DOT, EXTREME_DOT, UNKNOWN_DOT = (255, 255, 255), EITHER.reading, EITHER.refused, EITHER.faint
"""Colours of a sensor: innovation below 2 σ, below 3 σ, above, none yet."""

RIM = (51, 65, 85)


class PictureKind(NamedTuple):
    """PictureKind of picture of a field: name, title, short title, colours from low to high."""

    name: str
    title: str
    brief: str
    colors: tuple[str, ...]


ESTIMATE = PictureKind("estimate", "estimate", "estimate", WARM)
DEVIATION = PictureKind("std", "standard deviation", "std", SPREAD)
ERROR = PictureKind("error", "estimate − truth", "error", SIGNED)
TRUE = PictureKind("truth", "truth", "truth", WARM)


def kinds(truth: bool) -> tuple[PictureKind, ...]:
    """Return the kinds of pictures of a field."""
    return (ESTIMATE, DEVIATION, ERROR, TRUE) if truth else (ESTIMATE, DEVIATION)


def image_of(picture: Picture, kind: PictureKind) -> np.ndarray | None:
    """Return the values (rows, columns) of a kind of picture, or None."""
    if kind is ERROR:
        return None if picture.mean is None or picture.truth is None else picture.mean - picture.truth
    return {ESTIMATE.name: picture.mean, DEVIATION.name: picture.std, TRUE.name: picture.truth}[kind.name]


def gradient(colors: tuple[str, ...]) -> np.ndarray:
    """Return 255 interpolated colours and that of unknown values, (256, 3) uint8."""
    anchors = np.array([rgb(color) for color in colors], float)
    at = np.linspace(0, len(colors) - 1, UNKNOWN_INDEX)
    columns = [np.interp(at, np.arange(len(colors)), anchors[:, k]) for k in range(3)]
    return np.vstack((np.stack(columns, axis=1).round(), [[205, 205, 210]])).astype(np.uint8)


class Scale:
    """Range of a colour scale: round numbers that change rarely."""

    def __init__(self, kind: PictureKind) -> None:
        self.kind = kind
        self.low, self.high, self.step = np.nan, np.nan, 1.0

    def fit(self, values: np.ndarray) -> None:
        """Widen the range if values lie outside; narrow it if they fill less than half."""
        finite = values[np.isfinite(values)]
        if not finite.size:
            return
        if self.kind is ERROR:
            # A few cells at a front must not make the rest of the picture white.
            reach = float(np.quantile(np.abs(finite), 0.995))
            low, high = -reach, reach
        else:
            low, high = float(finite.min()), float(finite.max())
            if self.kind is DEVIATION:
                low = 0.0
        if self.low <= low and high <= self.high and high - low >= 0.5 * (self.high - self.low):
            return
        span = max(high - low, 1e-9 + 1e-6 * abs(high))
        self.step = round_step(span / 4.0)
        # To tenths of a step: a scale that ends at round numbers only could be twice as wide as the values.
        grain = self.step / 2.0
        self.low, self.high = np.floor(low / grain + 1e-9) * grain, np.ceil(high / grain - 1e-9) * grain
        if self.high <= self.low:
            self.high = self.low + self.step

    def indices(self, values: np.ndarray) -> np.ndarray:
        """Return the colour index of each value, uint8; unknown values get `UNKNOWN_INDEX`."""
        place = np.clip((values - self.low) / (self.high - self.low), 0.0, 1.0) * (UNKNOWN_INDEX - 1)
        return np.where(np.isfinite(values) & np.isfinite(place), place, UNKNOWN_INDEX).astype(np.uint8)

    def ticks(self) -> list[tuple[float, str]]:
        """Return places of tick labels from 0 (low) to 1 (high), with their text; none before the first value."""
        if not np.isfinite(self.low):
            return []
        width, step = self.high - self.low, self.step
        ticks = np.arange(np.ceil(self.low / step - 1e-9), np.floor(self.high / step + 1e-9) + 0.5) * step
        return [(float((tick - self.low) / width), tick_text(float(tick), step)) for tick in ticks]


@dataclass(frozen=True)
class PictureFrame:
    """Pixels of a field's picture: a cell takes `tall` × `wide`, so that distances keep their proportions."""

    field: Field
    rows: int
    columns: int
    tall: int
    wide: int
    reduced: int

    @staticmethod
    def of(field: Field) -> PictureFrame:
        """Return the frame of a field, about 150 pixels or larger."""
        rows, columns = plane_shape(field.shape)
        steps = field.steps[-2:] if len(field.shape) > 1 else (max(1.0, columns / 12) * field.steps[0], field.steps[0])
        ratio = steps[0] / steps[1]
        best = min(
            ((a, b) for a in range(1, 41) for b in range(1, 9)),
            key=lambda ab: abs(np.log(ab[0] / ab[1] / ratio)) + 0.02 * abs(np.log(ab[1] * columns / 180.0)),
        )
        return PictureFrame(field, rows, columns, best[0], best[1], reduction(field.shape))

    @property
    def height(self) -> int:
        """Pixels from top to bottom."""
        return self.rows * self.tall

    @property
    def width(self) -> int:
        """Pixels from left to right."""
        return self.columns * self.wide

    def enlarge(self, image: np.ndarray) -> np.ndarray:
        """Return a picture (rows, columns) in pixels."""
        return np.repeat(np.repeat(image, self.tall, axis=0), self.wide, axis=1)

    def pixels(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (k, axes) in the field as (across, down) in pixels (k, 2)."""
        cells = np.atleast_2d(positions) / np.array(self.field.steps)
        down = cells[:, -2] if cells.shape[1] > 1 else np.zeros(len(cells))
        scale = np.array([self.wide, self.tall]) / self.reduced
        return (np.stack((cells[:, -1], down), axis=1) + 0.5) * scale


def positioned(model: StateSpaceModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (k, axes) of sensor rows that have one, and (sensor, row) of each, (k, 2)."""
    found = [
        (row.position, (k, r))
        for k, sensor in enumerate(model.sensors)
        for r, row in enumerate(sensor.rows)
        if row.position is not None
    ]
    axes = len(model.grid.shape) if model.grid is not None else 1
    places = np.array([place for place, _ in found], float).reshape(-1, axes)
    return places, np.array([which for _, which in found], int).reshape(-1, 2)


def take_innovations(normalised: np.ndarray, which: np.ndarray, events: Events, track: Track) -> bool:
    """Update the latest innovation of each sensor row, in units of its deviation, and return whether any came.

    `normalised` (k,) is changed in place; `which` (k, 2) has sensor and row of each. The n events and rows are new.
    """
    found = False
    for k in np.unique(which[:, 0]):
        mine = events.of_sensor(k)
        if mine.size:
            of = which[:, 0] == k
            with np.errstate(invalid="ignore", divide="ignore"):
                ratio = track.innovation[mine[-1]] / track.innovation_std[mine[-1]]
            normalised[of] = ratio[which[of, 1]]
            found = True
    return found


def sensor_colors(normalised: np.ndarray) -> np.ndarray:
    """Return colours (k, 3) uint8 of innovations in units of their deviation (k,); NaN is a sensor without one."""
    size = np.abs(normalised)
    colors = np.full((size.size, 3), UNKNOWN_DOT, np.uint8)
    colors[size < 2.0] = NORMAL_DOT
    colors[(size >= 2.0) & (size < 3.0)] = LARGE_DOT
    colors[size >= 3.0] = EXTREME_DOT
    return colors


def round_step(span: float) -> float:
    """Return the smallest of 1, 2, 5 · 10ᵏ that is at least `span`."""
    power = 10.0 ** np.floor(np.log10(span))
    return float(next(step for step in (power, 2 * power, 5 * power, 10 * power) if step >= span * (1 - 1e-9)))


def tick_text(value: float, step: float) -> str:
    """Return the number of a tick with the decimals that its step needs."""
    if step < 1e-4 or abs(value) >= 1e6:
        return f"{value:.4g}"
    decimals = max(0, int(-np.floor(np.log10(step) + 1e-9)))
    return f"{value + 0.0:.{decimals}f}"


def with_deviation(value: float, deviation: float) -> str:
    """Return a value ± its deviation, with two digits of the deviation or one decimal."""
    if not deviation > 0 or not np.isfinite(deviation):
        return f"{value:.4g}"
    decimals = min(8, max(1, int(1 - np.floor(np.log10(deviation)))))
    return f"{value + 0.0:.{decimals}f} ± {deviation:.{decimals}f}"
