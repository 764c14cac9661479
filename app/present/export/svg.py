"""A chart over time as SVG: layers of curves, bands and dots in a frame with title, axes, units and legend, light."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape
from typing import NamedTuple

import numpy as np

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 820, 58, 18, 26, 22
"""Pixels: of the whole, and of the margins around the frame."""

INK, FAINT, GRID, WRONG, PANEL = "#14202f", "#5b6a7d", "#e5e9ef", "#c72a08", "#ffffff"

APART = 7
"""Pixels from one mark at the edge to the next."""

SHARE = 0.15
"""Of a chart, beyond which the tint of what was wrong fades, as what covers all tells nothing; its strip stays."""

SECONDS = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400)
"""Steps of a time axis."""


class Layer(NamedTuple):
    """What is drawn over one another: a line, a band from `y` to `low`, or dots (`radius`), rings if `ring`.

    `x` (n,) seconds, `y` (n,); NaN is a gap. `name` is what the legend says, "" for nothing.
    """

    name: str
    color: str
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray | None = None
    width: float = 1.5
    dash: str = ""
    radius: float = 0.0
    ring: bool = False


class Frame(NamedTuple):
    """A chart's name in its file, title, unit, note, height in pixels, and what its axes span.

    `ticks` are values and labels of the value axis, in place of round numbers; `says` puts a value in words.
    """

    key: str
    title: str
    unit: str
    note: str
    height: int
    span: tuple[float, float]
    extent: tuple[float, float]
    ticks: tuple[tuple[float, str], ...] | None = None
    says: Callable[[float], str] | None = None


def chart(frame: Frame, layers: Sequence[Layer], shades: Sequence[tuple[float, float]] = ()) -> str:
    """The chart; `shades` are stretches of time, s, in which something was wrong."""
    (left, right), (low, high) = frame.span, frame.extent
    inner = WIDTH - LEFT - RIGHT, frame.height - TOP - BOTTOM

    def x(value: np.ndarray | float) -> np.ndarray:
        return LEFT + (np.asarray(value) - left) / ((right - left) or 1.0) * inner[0]

    def y(value: np.ndarray | float) -> np.ndarray:
        return TOP + (high - np.asarray(value)) / ((high - low) or 1.0) * inner[1]

    heading = frame.title + (f" [{frame.unit}]" if frame.unit not in ("", "1") else "")
    body = [
        f'<svg viewBox="0 0 {WIDTH} {frame.height}" width="{WIDTH}" font-size="11" fill="{FAINT}" role="img" '
        f'aria-label="{escape(heading)}">',
        f'<clipPath id="{frame.key}"><rect x="{LEFT}" y="{TOP}" width="{inner[0]}" height="{inner[1]}"/></clipPath>',
    ]
    for value, text in frame.ticks or [(tick, number(tick)) for tick in ticks(low, high, inner[1] / 30)]:
        at = float(y(value))
        body.append(f'<path d="M{LEFT} {at:.1f}h{inner[0]}" stroke="{GRID}"/>')
        body.append(f'<text x="{LEFT - 5}" y="{at + 4:.1f}" text-anchor="end">{escape(text)}</text>')
    for value in time_ticks(left, right):
        at = float(x(value))
        body.append(f'<path d="M{at:.1f} {TOP}v{inner[1]}" stroke="{GRID}"/>')
        body.append(f'<text x="{at:.1f}" y="{frame.height - 7}" text-anchor="middle">{clock(value)}</text>')
    body.append(f'<g clip-path="url(#{frame.key})">')
    stretches = _stretches(shades, left, right)
    covered = sum(end - start for start, end in stretches)
    strength = min(1.0, SHARE * (right - left) / (covered or 1e-9))
    for start, end in stretches:
        place = f'x="{float(x(start)):.1f}" y="{TOP}" width="{max(2.0, float(x(end) - x(start))):.1f}"'
        body.append(f'<rect {place} height="{inner[1]}" fill="{WRONG}14" opacity="{strength:.3f}"/>')
        body.append(f'<rect {place} height="3" fill="{WRONG}a0"/>')
    body += [_layer(layer, x(layer.x), y(layer.y), None if layer.low is None else y(layer.low)) for layer in layers]
    body += _outsiders([layer for layer in layers if layer.low is None], frame, x)
    body.append("</g>")
    note = f'<tspan fill="{FAINT}" font-weight="400">  {escape(frame.note)}</tspan>' if frame.note else ""
    body.append(f'<text x="{LEFT}" y="16" fill="{INK}" font-size="12" font-weight="650">{escape(heading)}{note}</text>')
    body.append(_legend([layer for layer in layers if layer.name]))
    return "\n".join([*body, "</svg>"])


def _stretches(shades: Sequence[tuple[float, float]], left: float, right: float) -> list[list[float]]:
    """What of them is between two times, joined where they overlap."""
    found: list[list[float]] = []
    for start, end in sorted((max(left, start), min(right, end)) for start, end in shades):
        if found and start <= found[-1][1]:
            found[-1][1] = max(found[-1][1], end)
        elif end >= start:
            found.append([start, end])
    return found


def _outsiders(layers: Sequence[Layer], frame: Frame, x: Callable[[np.ndarray], np.ndarray]) -> list[str]:
    """Marks at the edges of the frame where a value lies beyond it, and of the furthest which it is."""
    body = []
    low, high = frame.extent
    for above, edge in ((True, TOP + 1), (False, frame.height - BOTTOM - 1)):
        slots: dict[int, tuple[float, float, str]] = {}
        for layer in layers:
            beyond = np.flatnonzero(layer.y > high if above else layer.y < low)
            for at, value in zip(x(layer.x[beyond]).tolist(), layer.y[beyond].tolist(), strict=True):
                slot = round(at / APART)
                if slot not in slots or (value > slots[slot][1]) is above:
                    slots[slot] = at, value, layer.color
        base = edge + (8 if above else -8)
        body += [
            f'<path d="M{at:.1f} {edge}L{at - 4:.1f} {base}h8Z" fill="{color}"/>' for at, _, color in slots.values()
        ]
        if slots:
            at, value, _ = (max if above else min)(slots.values(), key=lambda mark: mark[1])
            late = at > LEFT + 0.8 * (WIDTH - LEFT - RIGHT)
            side = f'x="{at - 7:.1f}" text-anchor="end"' if late else f'x="{at + 7:.1f}"'
            said = frame.says(value) if frame.says else f"{value:.4g} {frame.unit}".strip()
            # On a plate, as there may be much beneath it.
            wide = 6.2 * len(said) + 4
            left = at - 7 - wide if late else at + 5
            top = edge if above else edge - 12
            body.append(f'<rect x="{left:.1f}" y="{top}" width="{wide:.1f}" height="12" fill="{PANEL}"/>')
            body.append(f'<text {side} y="{edge + 9 if above else edge - 1}">{escape(said)}</text>')
    return body


def _layer(layer: Layer, x: np.ndarray, y: np.ndarray, low: np.ndarray | None) -> str:
    if layer.radius:
        known = np.isfinite(y)
        style = f'fill="none" stroke="{layer.color}" stroke-width="1.5"' if layer.ring else f'fill="{layer.color}"'
        circles = (
            f'<circle cx="{a:.1f}" cy="{b:.1f}" r="{layer.radius:g}"/>' for a, b in zip(x[known], y[known], strict=True)
        )
        return f"<g {style}>{''.join(circles)}</g>"
    if low is not None:
        known = np.isfinite(y) & np.isfinite(low)
        around = [*zip(x[known], y[known], strict=True), *zip(x[known][::-1], low[known][::-1], strict=True)]
        return f'<path d="{_path(np.array(around))}Z" fill="{layer.color}"/>' if around else ""
    dash = f' stroke-dasharray="{layer.dash}"' if layer.dash else ""
    d = _path(np.column_stack((x, y)))
    return f'<path d="{d}" fill="none" stroke="{layer.color}" stroke-width="{layer.width:g}"{dash}/>'


def _path(points: np.ndarray) -> str:
    """A line through points (n, 2), interrupted where one is no number."""
    parts, begin = [], True
    for x, y in points.tolist():
        if not math.isfinite(y):
            begin = True
            continue
        parts.append(f"{'M' if begin else 'L'}{x:.1f} {min(max(y, -9e3), 9e3):.1f}")
        begin = False
    return "".join(parts)


def _legend(layers: Sequence[Layer]) -> str:
    at, found = float(WIDTH - RIGHT), []
    for layer in reversed(layers):
        at -= 6.2 * len(layer.name) + 4
        found.append(f'<text x="{at:.0f}" y="16">{escape(layer.name)}</text>')
        at -= 20
        if layer.radius:
            style = f'fill="none" stroke="{layer.color}" stroke-width="1.5"' if layer.ring else f'fill="{layer.color}"'
            found.append(f'<circle cx="{at + 9:.0f}" cy="12" r="{layer.radius:g}" {style}/>')
        elif layer.low is not None:
            found.append(f'<rect x="{at:.0f}" y="8" width="15" height="8" fill="{layer.color}"/>')
        else:
            dash = f' stroke-dasharray="{layer.dash}"' if layer.dash else ""
            found.append(f'<path d="M{at:.0f} 12h15" stroke="{layer.color}" stroke-width="{layer.width:g}"{dash}/>')
        at -= 8
    return "".join(found)


def ticks(low: float, high: float, about: float) -> list[float]:
    """About so many round numbers from `low` to `high`; two at least, or they would tell no scale."""
    if not high > low:
        return [low]
    rough = (high - low) / max(1.0, about)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next((k * power for k in (1, 2, 5) if k * power >= rough), 10 * power)
    first = math.ceil(low / step - 1e-9)
    found = [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]
    return found if len(found) > 1 else ticks(low, high, 2.0 * max(1.0, about))


def time_ticks(low: float, high: float) -> list[float]:
    """Round times, s."""
    rough = (high - low) / 8
    if rough < SECONDS[0]:
        return ticks(low, high, 8)
    step = next((step for step in SECONDS if step >= rough), 86400 * math.ceil(rough / 86400))
    return [float(k * step) for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def number(value: float) -> str:
    """A label of a value axis."""
    return f"{round(value, 12):.6g}"


def clock(seconds: float) -> str:
    """Seconds as a clock: 0:07.3, 12:31, 3:05:00."""
    sign, rest = "-" if seconds < 0 else "", abs(seconds)
    minutes, part = divmod(round(rest, 3), 60)
    hours, minutes = divmod(int(minutes), 60)
    tail = f"{part:06.3f}".rstrip("0").rstrip(".")
    return f"{sign}{hours}:{minutes:02d}:{tail}" if hours else f"{sign}{minutes}:{tail}"
