"""The unit in which the chart of Viser's own window tells the time."""

import pytest

from app.views.viser.panel import unit_for

DAY = 86400.0


@pytest.mark.parametrize(
    ("span", "unit"),
    [(0.0, "s"), (179.0, "s"), (180.0, "min"), (3600.0, "min"), (10_800.0, "h"), (DAY, "h"), (3 * DAY, "d")],
)  # fmt: skip
def test_the_unit_suits_the_span(span, unit):
    assert unit_for(span).name == unit


def test_a_moment_is_told_in_it():
    assert unit_for(14 * DAY).text(3.5 * DAY) == "3.5000 d"
