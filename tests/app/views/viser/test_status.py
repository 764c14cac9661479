"""The status line of Viser's own window: a sign beside each colour, the cause, and what to do."""

import re

from app.views.viser.panel import SIGNS, note_html, status_html
from estimators.models import MODELS
from estimators.track import DIVERGED, HEALTH_NAMES, SUSPECT
from tests.app.fake_engine import FakeEngine
from tests.support import SECOND


def text(html):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html)).strip()


def test_every_state_has_a_sign_of_its_own():
    assert set(SIGNS) == set(HEALTH_NAMES)
    assert len(set(SIGNS.values())) == len(SIGNS)


def test_the_cause_is_in_the_status_and_cannot_bring_markup():
    status = FakeEngine(MODELS["motor_winding"], "kf").state
    status.health, status.since, status.t = SUSPECT, 3 * SECOND, 9 * SECOND
    status.cause, status.episodes_open = "winding reads 3 °C < the prediction", 3
    html = status_html(status, SECOND)
    assert "&lt; the prediction" in html and "< the" not in html
    assert text(html) == (
        f"{SIGNS['suspect']} suspect since 2.0 s revision 0 8.0 s winding reads 3 °C &lt; the prediction (2 more)"
    )
    status.health, status.cause = DIVERGED, ""
    assert "The readings contradict the estimate." in text(status_html(status, SECOND))


def test_a_note_cannot_bring_markup():
    assert note_html("") == ""
    assert "&lt;script&gt;" in note_html("<script>")
