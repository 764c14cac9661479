"""The panel's words about health: a sign beside each colour, sensors with their remedy, episodes that last."""

import re

import numpy as np

from app.viser.status import FEW, LEVELS, LIGHTS, episodes_html, sensors_html, status_html
from app.viser.time_units import UNITS
from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.sensor_states import STATES
from estimators.models import MODELS
from estimators.track import HEALTH_NAMES, SUSPECT
from tests.app.fake_engine import FakeEngine
from tests.support import SECOND


def text(html):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html)).strip()


def luminance(color):
    channels = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(channels <= 0.03928, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def test_every_state_has_a_sign_of_its_own_that_can_be_read_on_white():
    """Contrast 4.5 to 1 at least: WCAG 2.1, 1.4.3."""
    assert set(LIGHTS) == {*HEALTH_NAMES, *STATES}
    assert len({sign for sign, _ in LIGHTS.values()}) == len(LIGHTS)
    for state, (_, color) in LIGHTS.items():
        assert 1.05 / (luminance(color) + 0.05) >= 4.5, state


def test_the_cause_and_the_lights_are_in_the_status():
    status = FakeEngine(MODELS["motor_winding"], "kf").state
    status.health, status.since, status.t = SUSPECT, 3 * SECOND, 9 * SECOND
    status.cause, status.episodes_open = "winding reads 3 °C < the prediction", 3
    status.sensors = {"winding": ("suspect", status.cause), "tooth_tip": ("held out", "")}
    html = status_html(status, SECOND)
    assert "&lt; the prediction" in html
    shown = text(html)
    assert shown.startswith(f"{LIGHTS['suspect'][0]} suspect since 2.0 s")
    assert f"{LIGHTS['suspect'][0]} winding suspect" in shown and f"{LIGHTS['held out'][0]} tooth tip held out" in shown
    assert shown.endswith("winding reads 3 °C &lt; the prediction (2 more under Events)")


def test_of_many_sensors_the_lights_are_counted():
    status = FakeEngine(MODELS["motor_winding"], "kf").state
    status.sensors = {f"s{k}": ("tracking" if k else "stale", "") for k in range(FEW + 1)}
    shown = text(status_html(status, None))
    assert f"{FEW} sensors tracking" in shown and "1 sensors stale" in shown and "s0" not in shown


def test_a_sensor_in_order_needs_no_words():
    assert "Nothing is wrong" in sensors_html({"a": ("tracking", ""), "b": ("held out", "")})
    shown = text(sensors_html({"a": ("tracking", ""), "b": ("degraded", "b is stuck at 4; hold it out")}))
    assert shown == f"{LIGHTS['degraded'][0]} b degraded b is stuck at 4; hold it out"


def test_what_lasts_is_shown_with_its_remedy_and_what_is_over_is_not():
    over = Episode(2.0, 3.0, "b", "wide", 0.5, 0.4, 0.6, "×", "bands of b are too wide")
    lasting = Episode(63.0, None, "a", "never heard", 9.0, np.nan, np.nan, "s", "a was never heard; check its bus")
    assert episodes_html([over], SECOND) == ""
    html = episodes_html([over, lasting], 3 * SECOND, UNITS[1])
    shown = text(html)
    assert shown == "Now a: never heard since 1.00 min · ALARMS.md#never-heard a was never heard; check its bus"
    assert LEVELS["warn"] in html
