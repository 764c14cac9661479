"""The page's colours, measured: contrast, and whether who sees no red, green or blue tells them apart.

Contrast is that of WCAG 2.2 (relative luminance; 4.5 for text, 3 for lines, dots and the edges of controls). Colour
blindness is that of Machado, Oliveira & Fernandes (2009), doi:10.1109/TVCG.2009.113, at full severity, on linear RGB;
what it leaves is compared by CIEDE2000 (Sharma, Wu & Dalal, 2005), of which 2.3 is a just noticeable difference.
"""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from app.charts.colors import THEMES as PALETTES
from app.charts.colors import mixed

STYLE = Path("app/web/page/chart.css").read_text()
TEXT, GRAPHIC = 4.5, 3.0
APART = 8.0
"""CIEDE2000 between two lines, between dots, or between health colours: three to four just noticeable differences."""

ASIDE = 5.5
"""The same between lines and dots, which differ in shape too."""

SEEN = {
    "all colours": np.eye(3),
    "no red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "no green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "no blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
LINES = ("estimate", "truth", "previous", "smoothed", "pin-0", "pin-1", "pin-2", "pin-3")
DOTS = ("reading", "refused")
HEALTH = ("tracking", "advisory", "suspect", "degraded", "diverged", "waiting")


def theme(selector):
    """The variables of a theme: name to (red, green, blue, alpha), 0 to 1."""
    rule = STYLE.partition(f"\n{selector} {{")[2].partition("\n}")[0]
    found = re.findall(r"--([\w-]+): #([0-9a-f]{6})([0-9a-f]{2})?;", rule)
    return {name: np.frombuffer(bytes.fromhex(color + (alpha or "ff")), np.uint8) / 255 for name, color, alpha in found}


THEMES = {"light": theme(":root"), "dark": theme(':root[data-theme="dark"]')}


def linear(color):
    color = np.asarray(color)
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def over(top, below):
    """A colour with an alpha on an opaque one."""
    return np.append(top[3] * top[:3] + (1 - top[3]) * below[:3], 1.0)


def contrast(a, b):
    low, high = sorted(float(linear(color[:3]) @ XYZ[1]) for color in (a, b))
    return (high + 0.05) / (low + 0.05)


def lab(color):
    xyz = XYZ @ np.clip(color, 0, 1) / XYZ.sum(axis=1)
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return 116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])


def difference(one, other):
    """CIEDE2000 of two colours of CIELAB."""
    (l1, a1, b1), (l2, a2, b2) = one, other
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    g = 0.5 * (1 - np.sqrt(mean**7 / (mean**7 + 25.0**7)))
    c1, c2 = np.hypot((1 + g) * a1, b1), np.hypot((1 + g) * a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, (1 + g) * a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    turn = 0.0 if c1 * c2 == 0 else (h2 - h1 + 180) % 360 - 180
    chroma, light = (c1 + c2) / 2, (l1 + l2) / 2
    hue = h1 + h2 if c1 * c2 == 0 else (h1 + turn / 2) % 360
    t = (
        1 - 0.17 * np.cos(np.radians(hue - 30)) + 0.24 * np.cos(np.radians(2 * hue))
        + 0.32 * np.cos(np.radians(3 * hue + 6)) - 0.20 * np.cos(np.radians(4 * hue - 63))
    )  # fmt: skip
    by_light = (l2 - l1) / (1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2))
    by_chroma = (c2 - c1) / (1 + 0.045 * chroma)
    by_hue = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2)) / (1 + 0.015 * chroma * t)
    rotation = (
        -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7)) * np.sin(np.radians(60 * np.exp(-(((hue - 275) / 25) ** 2))))
    )
    return float(np.sqrt(by_light**2 + by_chroma**2 + by_hue**2 + rotation * by_chroma * by_hue))


def test_the_formulas_are_those_of_their_sources():
    # WCAG: black on white; the grey #767676, the lightest that may be text on white. Sharma et al., table 1.
    assert contrast(np.ones(4), np.array([0, 0, 0, 1])) == pytest.approx(21.0)
    grey = np.array([0x76, 0x76, 0x76, 255]) / 255
    assert contrast(grey, np.ones(4)) == pytest.approx(4.54, abs=0.005)
    assert difference((50, 2.6772, -79.7751), (50, 0, -82.7485)) == pytest.approx(2.0425, abs=1e-4)
    assert difference((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514)) == pytest.approx(0.9082, abs=1e-4)
    assert difference((50, 2.5, 0), (58, 24, 15)) == pytest.approx(19.4535, abs=1e-4)
    # Each kind of eye sees white and black as such.
    np.testing.assert_allclose([np.sum(matrix, axis=1) for matrix in SEEN.values()], 1.0, atol=1e-5)


@pytest.mark.parametrize("name", THEMES)
def test_scenes_and_files_have_the_colours_of_the_page(name):
    palette = PALETTES[name]
    for key in ("panel", "estimate", "truth", "refused"):
        assert np.array(getattr(palette, key)) / 255 == pytest.approx(THEMES[name][key][:3])
    for health, color in palette.health.items():
        assert np.array(color) / 255 == pytest.approx(THEMES[name][f"health-{health}"][:3])
    assert mixed((0, 100, 200), (100, 0, 200), 0.25) == (25, 75, 200)


@pytest.mark.parametrize("name", THEMES)
def test_text_stands_out(name):
    colors = THEMES[name]
    grounds = {key: colors[key] for key in ("panel", "ground", "grid")}
    for text in ("ink", "faint", "accent", "health-diverged", "health-degraded"):
        for key, ground in grounds.items():
            if text.startswith("health") and key != "panel":
                continue  # what is wrong is said on panels only
            assert contrast(colors[text], ground) >= TEXT, f"{text} on {key}: {contrast(colors[text], ground):.2f}"


@pytest.mark.parametrize("name", THEMES)
def test_lines_dots_and_edges_stand_out(name):
    colors = THEMES[name]
    panel = colors["panel"]
    grounds = {"panel": panel, "band": over(colors["band"], panel), "episode": over(colors["episode"], panel)}
    for line in (*LINES, *DOTS, "integrity", "bound", "quiet", "edge", *(f"health-{health}" for health in HEALTH)):
        assert contrast(colors[line], panel) >= GRAPHIC, f"{line}: {contrast(colors[line], panel):.2f}"
    # These lie on bands and marks as well, where 3 is asked of what the eye follows and 2.4 of the dots beside it.
    for line, least in {"estimate": GRAPHIC, "truth": GRAPHIC, "refused": GRAPHIC, "reading": 2.4}.items():
        for key, ground in grounds.items():
            assert contrast(colors[line], ground) >= least, f"{line} on {key}: {contrast(colors[line], ground):.2f}"


@pytest.mark.parametrize("eye", SEEN)
@pytest.mark.parametrize("name", THEMES)
def test_every_eye_tells_the_colours_apart(name, eye):
    """With the colours that an eye is left with, no two meanings are one."""
    left = {key: lab(np.array(SEEN[eye]) @ linear(color[:3])) for key, color in THEMES[name].items()}
    close = []
    for group in ((*LINES, *DOTS), tuple(f"health-{health}" for health in HEALTH)):
        for a, b in itertools.combinations(group, 2):
            least = ASIDE if (a in DOTS) != (b in DOTS) else APART
            if (found := difference(left[a], left[b])) < least:
                close.append(f"{a} and {b}: {found:.1f}")
    assert close == []
