"""Charts as SVG: every mark stands where its value is, by arithmetic of its own."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from app.present.export.svg import Frame, Layer, chart, clock, ticks, time_ticks

FRAME = Frame("c", "speed <x>", "m/s", "a & b", 148, (0.0, 744.0), (0.0, 10.0))
"""A pixel a second, from 58 on; ten pixels a unit, from 126 upwards."""


def drawn(*layers, shades=()):
    return ElementTree.fromstring(chart(FRAME, layers, shades))


def group(root):
    return next(node for node in root if node.tag == "g")


def test_a_line_is_where_its_values_are_and_has_gaps():
    x, y = np.array([0.0, 100.0, 200.0, 300.0, 744.0]), np.array([0.0, 5.0, np.nan, 10.0, 2.5])
    (path,) = group(drawn(Layer("estimate", "#123456", x, y)))
    assert path.get("d") == "M58.0 126.0L158.0 76.0M358.0 26.0L802.0 101.0"
    assert path.get("stroke") == "#123456" and path.get("fill") == "none"


def test_bands_dots_rings_and_shades():
    x, y = np.array([0.0, 10.0]), np.array([8.0, np.nan])
    band = Layer("± 2σ", "#0b62c426", x, np.array([6.0, 7.0]), np.array([1.0, 2.0]))
    root = drawn(band, Layer("reading", "#d98a00", x, y, radius=2), Layer("", "#cc3f0c", x, y, radius=3, ring=True),
                 shades=[(-5.0, 44.0), (50.0, 50.0)])  # fmt: skip
    first, strip, second, second_strip, area, dots, rings = group(root)
    assert (first.get("x"), first.get("width"), first.get("height")) == ("58.0", "44.0", "100")
    assert (second.get("x"), second.get("width"), second.get("height")) == ("108.0", "2.0", "100")
    assert [(bar.get("x"), bar.get("width"), bar.get("height")) for bar in (strip, second_strip)] == [
        ("58.0", "44.0", "3"), ("108.0", "2.0", "3"),
    ]  # fmt: skip
    assert first.get("opacity") == second.get("opacity") == "1.000"
    assert area.get("d") == "M58.0 66.0L68.0 56.0L68.0 106.0L58.0 116.0Z"
    assert [(c.get("cx"), c.get("cy"), c.get("r")) for c in dots] == [("58.0", "46.0", "2")]
    assert dots.get("fill") == "#d98a00" and rings.get("fill") == "none" and len(rings) == 1
    words = ["".join(node.itertext()) for node in root.iter("text")]
    assert "speed <x> [m/s]  a & b" in words and {"± 2σ", "reading"} <= set(words)


def test_what_was_wrong_nearly_all_the_time_is_tinted_less_and_once():
    """Of 744 s half, told of by two episodes that overlap: as much ink as 15 % of the chart would have."""
    tint, strip = group(drawn(shades=[(172.0, 400.0), (0.0, 372.0)]))
    assert (tint.get("x"), tint.get("width")) == (strip.get("x"), strip.get("width")) == ("58.0", "400.0")
    assert float(tint.get("opacity")) == pytest.approx(0.15 * 744 / 400, abs=1e-3) and strip.get("opacity") is None


def test_what_lies_beyond_the_axis_is_marked_at_its_edge():
    x, y = np.array([100.0, 103.0, 400.0, 700.0]), np.array([12.0, 5e3, 5.0, -2.0])
    *_, above, plate, said_above, below, _, said_below = group(drawn(Layer("reading", "#d98a00", x, y, radius=2)))
    assert (plate.get("x"), plate.get("fill")) == ("166.0", "#ffffff")
    # Two within seven pixels are one mark, that of the further.
    assert above.get("d") == "M161.0 27L157.0 35h8Z" and above.get("fill") == "#d98a00"
    assert said_above.text == "5000 m/s" and said_above.get("x") == "168.0"
    assert below.get("d") == "M758.0 125L754.0 117h8Z"
    assert said_below.text == "-2 m/s" and said_below.get("text-anchor") == "end"


@pytest.mark.parametrize(("low", "high"), [(0.0, 10.0), (-3.2e-7, 4e-7), (1e6, 1.0001e6), (38.25, 41.5)])
def test_ticks_are_round_and_inside(low, high):
    found = ticks(low, high, 5)
    steps = np.diff(found)
    assert 2 <= len(found) <= 11 and low - 1e-9 * high <= found[0] and found[-1] <= high * (1 + 1e-9)
    assert np.allclose(steps, steps[0]) and re.fullmatch(r"[125]e[+-]\d+", f"{steps[0]:.0e}")


def test_a_low_chart_has_two_ticks():
    """About one: of a range from -2700 to 2700 that would be zero alone."""
    assert ticks(-2700.0, 2700.0, 1.0) == [-2000.0, 0.0, 2000.0]


def test_times():
    assert time_ticks(0.0, 60.0) == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0]
    assert time_ticks(3500.0, 7300.0) == [3600.0, 4200.0, 4800.0, 5400.0, 6000.0, 6600.0, 7200.0]
    assert [clock(t) for t in (0.0, 7.3, 59.9996, 751.0, 11100.0, -3.0)] == [
        "0:00", "0:07.3", "1:00", "12:31", "3:05:00", "-0:03",
    ]  # fmt: skip
