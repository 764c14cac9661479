"""Dual estimation on the page: what won is a card, with its evidence; accepted it is a version, dismissed gone."""

import pytest

from app.derive.refits import Refits
from app.twin.versions import listing
from tests.app.web.page.browsed import running, settled
from tests.app.web.page.test_fit_browser import TRUE, WRONG
from tests.waiting import wait_for

pytestmark = pytest.mark.browser


@pytest.fixture
def session(tmp_path, monkeypatch):
    # Where versions of twins that ship are kept.
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    # Looked at in the midst of a log that is read at once, the first window would end wherever that was.
    is_due = Refits._is_due
    monkeypatch.setattr(
        Refits, "_is_due", lambda self, section: self._engine.status().finished and is_due(self, section)
    )
    section = "{entries: [R.winding], every: 10 min, window: 15 min}"
    overrides = {"R.winding": str(WRONG), "source.duration": "1200", "refit": section}
    with running("motor_winding", **overrides) as session:
        wait_for(lambda: session.running.refits.open is not None)
        yield session


@pytest.fixture
def page(visit, session):
    page = visit(session.url)
    wait_for(lambda: page.locator("#refit-accept").count() == 1)
    return page


def test_accepted_it_is_a_version_that_runs(page, session):
    engine = session.engine
    (line,) = session.running.refits.open.attempt.fitted.lines
    assert line.low < TRUE < line.high
    row = page.locator("#refit tbody tr").inner_text()
    assert row.startswith("R.winding") and "100 → " in row and "σ" in row
    # Every fit, with its evidence.
    page.locator("#refit-open").click()
    wait_for(lambda: page.locator("#refit-panel details").count() == 1)
    page.locator("#refit-panel details summary").click()
    wait_for(lambda: page.locator("#refit-panel .verdict").is_visible())
    assert page.locator("#refit-panel .verdict").inner_text().startswith("Better on the blocks held out: +")
    assert (
        "fitted every 10 min on the last 15 min; what is better waits here" in page.locator("#refit-panel").inner_text()
    )
    page.keyboard.press("Escape")

    page.locator("#refit-accept").click()
    settled(engine, 1)
    assert engine.tuning.name == "refit-1" and engine.tuning.get("R.winding") == line.after
    wait_for(lambda: page.locator("#refit .offers").count() == 0)
    (_, kept) = listing(engine.twin)
    assert kept["name"] == "refit-1" and kept["evidence"]["entries"]["R.winding"]["after"] == line.after


def test_dismissed_it_is_gone_and_not_offered_again(page, session):
    page.locator("#refit-dismiss").click()
    wait_for(lambda: page.locator("#refit .offers").count() == 0)
    assert len(listing(session.engine.twin)) == 1 and session.engine.revisions.runs[-1].number == 0
    page.locator("#refit-open").click()
    page.locator("#refit-begin").click()
    wait_for(lambda: session.running.refits.known[-1].number == 2)
    wait_for(lambda: session.running.refits.known[-1].state == "dismissed")
    wait_for(lambda: page.locator("#refit-panel details").count() == 2)
    assert page.locator("#refit .offers").count() == 0
