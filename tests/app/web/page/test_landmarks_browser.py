"""The sensors of a family, one for each landmark, have one slider and one switch on the page."""

import pytest

from app.live.runs.sweep import Sweeps, noise
from tests.app.twin.test_landmarks import LANDMARKS, folder  # noqa: F401  a fixture
from tests.app.web.page.browsed import running, settled, until

pytestmark = pytest.mark.browser


def test_landmarks_share_a_slider_and_a_switch(folder, visit):  # noqa: F811
    with running(str(folder / "one.yaml")) as session:
        page = visit(session.url)
        keys = page.evaluate("[...document.querySelectorAll('.knob[data-key]')].map((knob) => knob.dataset.key)")
        assert [key for key in keys if key[:2] in ("R.", "p.")] == ["R.sighting.range", "R.sighting.bearing", "p.scale"]
        switches = page.locator("label.sensor")
        assert page.locator("label.sensor span").all_inner_texts() == [f"sighting ({len(LANDMARKS)})"]
        # The value is set for every landmark.
        field = page.locator('.knob[data-key="R.sighting.range"] input[type=text]')
        field.fill("0.25")
        field.press("Enter")
        settled(session.engine, 1)
        assert session.engine.status().tuning.r[::2].tolist() == [0.25] * 3
        # So is the value that the innovations imply: 0.1 m and 0.02 rad in the recording.
        found = noise(session.engine, Sweeps(session.engine)).sensors
        assert list(found) == ["R.sighting.range", "R.sighting.bearing"]
        # Of the order of the recording's 0.01 m², and far from the 0.25 that were just set.
        assert found["R.sighting.range"].n > 300 and 0.003 < found["R.sighting.range"].variance < 0.03
        # Held out, all at once, and used again.
        for number, used in ((2, False), (3, True)):
            switches.locator("input").click()
            settled(session.engine, number)
            assert session.engine.status().tuning.used.tolist() == [used] * 3
            until(page, f"document.querySelector('label.sensor input').checked === {str(used).lower()}")
            if not used:
                until(page, "document.querySelector('label.sensor em').textContent === 'held out'")
                page.screenshot(path=folder / "landmarks.png")
