"""The palette in Python is that of the page."""

import dataclasses
import re
from pathlib import Path

import pytest

from app.present.drawing.colors import THEMES, mixed, rgb

STYLE = Path("app/web/page/chart.css")


def variables(selector):
    """The colours that a rule of the page's style sets, by name."""
    rule = re.search(rf"^{re.escape(selector)} \{{(.*?)^\}}", STYLE.read_text(), re.MULTILINE | re.DOTALL)
    return {name: rgb(color) for name, color in re.findall(r"--([\w-]+): (#[0-9a-f]{6});", rule[1])}


@pytest.mark.parametrize(("theme", "selector"), [("light", ":root"), ("dark", ':root[data-theme="dark"]')])
def test_the_palette_is_that_of_the_page(theme, selector):
    found, palette = variables(selector), THEMES[theme]
    for item in dataclasses.fields(palette):
        if item.name != "health":
            assert getattr(palette, item.name) == found[item.name], item.name
    assert palette.health == {
        name.removeprefix("health-"): color for name, color in found.items() if name.startswith("health-")
    }


def test_a_mixture_lies_between():
    assert rgb("#0aff10") == (10, 255, 16)
    assert mixed((0, 100, 200), (100, 0, 200), 0.25) == (25, 75, 200)
