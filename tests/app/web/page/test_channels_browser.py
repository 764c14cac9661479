"""Hundreds of sensors are one group on the page: one light, one line and one chart, which open to its members.

Those of a family, one for each landmark, have one slider and one switch.
"""

import numpy as np
import pytest

from app.derive.sweep import Sweeps, noise
from app.engine.copies import Cursor
from tests.app.twin.test_landmarks import LANDMARKS, folder  # noqa: F401  a fixture
from tests.app.web.page.browsed import running, settled, until
from tests.models import write_plant
from tests.waiting import wait_for

pytestmark = pytest.mark.browser

COUNT, BIASED = 400, 123
LISTED = 24  # members of an open group that are listed at once


def innovations(engine, sensor):
    pull = engine.pull(Cursor())
    return pull.track.innovation[pull.events.channel == sensor, 0]


@pytest.mark.parametrize("family", [False, True])
def test_a_group_opens_to_its_members(tmp_path, visit, family):
    path = write_plant(tmp_path, COUNT, family=family, seconds=60, biased=BIASED)
    name = "TT_{:04d}" if family else "TT{:04d}"
    shown = name.replace("_", " ")  # names are shown in words
    with running(str(path)) as session:
        page = visit(session.url)
        count = page.locator
        until(page, "document.querySelector('.light')?.dataset.health !== 'waiting'")
        states = {key: state for key, (state, _) in session.engine.status().sensors.items() if state != "tracking"}
        # The one that is biased by ten standard deviations stays rejected; among 400 no other is in alarm.
        assert list(states) == [name.format(BIASED)]
        assert count(".light").count() == 1 and count(".light").inner_text().split("\n")[-1] == f"TT (1 of {COUNT})"
        assert count(".light").get_attribute("data-health") == states[name.format(BIASED)]
        # One line and one chart for all; nothing is hidden in the document.
        assert count(".sensor").count() == 1 and count(".sensor-group em").inner_text().startswith("1 in alarm")
        assert count("#charts article.chart").count() == 2 + LISTED + 2  # picture and spread, states, NIS, innovations
        assert count(".knob[data-key^='R.']").count() == (1 if family else LISTED)
        # The chart follows the first that is in alarm.
        field = page.get_by_label("Sensor of TT")
        until(page, f"document.querySelector('.member').value === '{shown.format(BIASED)}'")
        page.screenshot(path=tmp_path / "closed.png")
        # A click on the light opens the group: the faulty one first.
        count(".light").click()
        rows = count(".sensor-group .sensor span")
        until(page, f"document.querySelectorAll('.sensor-group > div .sensor').length === {LISTED}")
        assert rows.all_inner_texts()[1] == shown.format(BIASED)
        page.screenshot(path=tmp_path / "open.png")
        # A name is found, and charted.
        page.get_by_label("Find a sensor").fill(shown.format(377))
        until(page, "document.querySelectorAll('.sensor-group > div .sensor').length === 1")
        page.get_by_label(f"Chart {shown.format(377)}").click()
        assert field.input_value() == shown.format(377)
        expected = innovations(session.engine, 377)
        column = f"innovation:{name.format(377)}"
        until(page, f"window.nisus.charts.live.columns['{column}']?.some((value) => value !== null)")
        drawn = page.evaluate(
            f"window.nisus.charts.live.columns['{column}'].filter((value) => typeof value === 'number')"
        )
        assert len(drawn) > 40 and all(np.abs(expected - value).min() < 1e-5 for value in drawn)
        # The chart takes a name as it is shown, and as it is written.
        for text, k in ((shown.format(42), 42), (name.format(43), 43)):
            field.fill(text)
            field.press("Enter")
            until(page, f"document.querySelector('.member').value === '{shown.format(k)}'")
            assert f"innovation:{name.format(k)}" in page.evaluate("window.nisus.charts.columns")


def test_a_status_of_many_entries_is_sent_by_what_changed():
    from app.web.streams import MANY_ENTRIES, changes

    sensors = {f"s{k}": {"state": "tracking"} for k in range(MANY_ENTRIES)}
    before = {"t": 1, "sensors": sensors, "counts": {"readings": 3}}
    assert changes({}, before) == {"status": before}
    now = {"t": 2, "sensors": sensors | {"s3": {"state": "suspect"}}, "counts": {"readings": 4}}
    assert changes(before, now) == {
        "status": {"t": 2, "counts": {"readings": 4}},
        "entries": {"sensors": {"s3": {"state": "suspect"}}},
    }
    assert changes(now, now) == {}
    fewer = {"t": 2, "sensors": {"s1": sensors["s1"]}, "counts": {"readings": 4}}
    assert changes(now, fewer) == {"status": {"sensors": fewer["sensors"]}}


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
        for used in (False, True):
            switches.locator("input").click()
            wait_for(lambda used=used: session.engine.status().tuning.used.tolist() == [used] * 3)
            until(page, f"document.querySelector('label.sensor input').checked === {str(used).lower()}")
            if not used:
                until(page, "document.querySelector('label.sensor em').textContent === 'held out'")
                page.screenshot(path=folder / "landmarks.png")
