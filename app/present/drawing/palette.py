"""The colours of the page, for Viser's scenes and Rerun's charts: one meaning each, in light and in dark.

`app/web/page/style.css` has the same under the same names (a test compares them), chosen so that who sees no red or no
green tells them apart (after Okabe and Ito, 2008).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

RGB = tuple[int, int, int]


def rgb(color: str) -> RGB:
    """`#rrggbb` as three numbers from 0 to 255."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def mixed(a: RGB, b: RGB, share: float) -> RGB:
    """A colour between two: `share` of the second."""
    x, y, z = (round(p + share * (q - p)) for p, q in zip(a, b, strict=True))
    return x, y, z


@dataclass(frozen=True)
class Palette:
    """One theme; `health` is by the names of `HEALTH_NAMES`."""

    ground: RGB
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


LIGHT = Palette(
    ground=rgb("#f3f5f8"), panel=rgb("#ffffff"), ink=rgb("#14202f"), faint=rgb("#5b6a7d"), rule=rgb("#d9dfe8"),
    grid=rgb("#edf0f4"), estimate=rgb("#0b62c4"), truth=rgb("#111827"), reading=rgb("#c47b00"), refused=rgb("#c72a08"),
    previous=rgb("#808b98"), bound=rgb("#8390a1"), smoothed=rgb("#264c46"),
    health={
        "waiting": rgb("#7b8798"), "tracking": rgb("#007d57"), "suspect": rgb("#c08200"), "degraded": rgb("#ab3f00"),
        "diverged": rgb("#7d1224"), "stale": rgb("#7b8798"),
    },
)  # fmt: skip

DARK = Palette(
    ground=rgb("#0c1118"), panel=rgb("#131a23"), ink=rgb("#e4eaf2"), faint=rgb("#94a3b5"), rule=rgb("#273242"),
    grid=rgb("#1c2531"), estimate=rgb("#69b1ff"), truth=rgb("#f3f4f6"), reading=rgb("#f2b134"), refused=rgb("#f0592c"),
    previous=rgb("#6c7788"), bound=rgb("#7d8b9e"), smoothed=rgb("#a8d293"),
    health={
        "waiting": rgb("#8a97a8"), "tracking": rgb("#2ecd9b"), "suspect": rgb("#ffe066"), "degraded": rgb("#d98a2d"),
        "diverged": rgb("#e85a6e"), "stale": rgb("#8a97a8"),
    },
)  # fmt: skip

THEMES = {"light": LIGHT, "dark": DARK}


def between(a: Palette, b: Palette) -> Palette:
    """The palette halfway between two."""
    both = {
        item.name: mixed(getattr(a, item.name), getattr(b, item.name), 0.5)
        for item in fields(Palette)
        if item.name != "health"
    }
    return Palette(**both, health={name: mixed(color, b.health[name], 0.5) for name, color in a.health.items()})


EITHER = between(LIGHT, DARK)
"""For files: nobody knows on what ground their viewer draws."""
