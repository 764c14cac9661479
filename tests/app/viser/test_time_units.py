"""The unit in which charts tell the time."""

import numpy as np
import pytest

from app.viser.status import events_html, status_html
from app.viser.time_units import SECONDS, UNITS, unit_for, window_name
from app.viser.view import ViserView
from estimators.log import READING
from estimators.models import MODELS
from tests.app.fake_engine import FakeEngine, events

WINDING = MODELS["motor_winding"]
DAY = 86400.0


@pytest.mark.parametrize(
    ("span", "unit"),
    [(0.0, "s"), (179.0, "s"), (180.0, "min"), (3600.0, "min"), (10_800.0, "h"), (DAY, "h"), (3 * DAY, "d")],
)  # fmt: skip
def test_the_unit_suits_the_span(span, unit):
    assert unit_for(span).name == unit


@pytest.mark.parametrize(
    ("window", "name"),
    [(10.0, "10 s"), (60.0, "60 s"), (300.0, "5 min"), (200.0, "200 s"), (7200.0, "120 min"), (259_200.0, "3 d")],
)
def test_windows_have_round_names(window, name):
    assert window_name(window) == name


def test_a_span_that_wavers_while_it_grows_changes_the_unit_three_times():
    spans = np.geomspace(1.0, 20 * DAY, 2000) * (1.0 + 0.3 * np.sin(np.arange(2000)))
    unit, seen = SECONDS, [SECONDS]
    for span in spans:
        unit = unit_for(float(span), unit)
        if unit != seen[-1]:
            seen.append(unit)
    assert tuple(seen) == UNITS
    # And back, when little is shown.
    assert unit_for(0.9 * DAY, unit).name == "h" and unit_for(1.1 * DAY, unit).name == "d"


def test_axes_values_and_status_of_all_that_there_is_change_together():
    engine = FakeEngine(WINDING, "kf")
    view = ViserView(engine, secret="s3cret")
    try:
        view._wanted_window = "all"
        days = 0.0
        for length, unit, seconds in ((100.0, "s", 1.0), (4 * 3600.0, "h", 3600.0), (14 * DAY, "d", DAY)):
            t = np.linspace(days + 1.0, length, 50)
            days = length
            engine.put(events(WINDING, READING, 0, t, np.full(50, 40.0)))
            view.frame()
            for chart in view.charts._charts:
                assert chart.axes[0]["label"] == unit
                assert chart.data[0][-1] == pytest.approx((length - 1.0) / seconds)
            assert view.charts._nis_chart.axes[0]["label"] == unit
            last = view.charts.unit.text(length - 1.0)
            assert last.endswith(f" {unit}") and last in view.panel.status.content
        assert last == "14.0000 d"
        assert "14.0000 d" in status_html(engine.status(), int(1e9), view.charts.unit)
        assert "Nothing" in events_html([], None, view.charts.unit)
    finally:
        view.stop()
