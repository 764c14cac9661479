"""Fit and versions on the page: a wrong R is fitted, applied as one edit and undone; a worse fit is not proposed."""

import json
import re

import pytest

from app.twin.twin import with_version
from app.twin.versions import listing
from tests.app.served import VERDICT, keep_verdicts
from tests.app.web.page.browsed import running, settled
from tests.waiting import LIMIT_S, wait_for

pytestmark = pytest.mark.browser

TRUE = 4.0
"""Variance of the noise in motor_winding's recording, which was simulated, °C²."""

WRONG = 100.0


@pytest.fixture
def session(tmp_path, monkeypatch):
    # Where versions of twins that ship are kept.
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with running("motor_winding", **{"R.winding": str(WRONG), "source.duration": "1200"}) as session:
        yield session


def fitted(page):
    """The fit's answer, once it is there."""
    before = page.evaluate("window.nisus.tune.fit.told?.number ?? 0")
    page.locator("#fit-begin").click()
    wait_for(lambda: page.evaluate("window.nisus.tune.fit.told?.number ?? 0") == before + 1)
    wait_for(lambda: page.locator("#fit-panel .progress").is_hidden())
    assert verdict(page) is not None
    return json.loads(page.evaluate("JSON.stringify(window.nisus.tune.fit.told)"))


def verdict(page):
    found = page.locator("#fit-panel .verdict")
    return found.inner_text() if found.count() else None


def test_what_is_wrong_is_found_put_in_and_taken_back(page, session):
    engine = session.engine
    assert engine.tuning.get("R.winding") == WRONG
    page.locator("#fit").click()
    # Opened by the keyboard or the mouse, the first thing that can be chosen has the focus.
    wait_for(lambda: page.evaluate("document.activeElement?.closest('#fit-panel') !== null"))
    told = fitted(page)
    assert told["result"]["proposed"], told["result"]["verdict"]
    assert verdict(page).startswith("Better on the blocks held out: +")
    line = next(line for line in told["result"]["entries"] if line["key"] == "R.winding")
    assert line["low"] < TRUE < line["high"]
    row = page.locator("#fit-panel table.entries tbody tr", has_text="R.winding").locator("td")
    assert float(row.nth(0).inner_text()) == WRONG
    assert float(row.nth(1).inner_text()) == pytest.approx(line["after"], rel=1e-3)
    assert "held out" in page.locator("#fit-panel table.scores thead").inner_text()

    # Kept as a version, with what it was worth on the blocks held out.
    page.locator("#fit-name").fill("found")
    page.locator("#fit-keep").click()
    wait_for(lambda: len(listing(engine.twin)) == 2)
    kept = listing(engine.twin)[1]
    assert kept["name"] == "found" and kept["note"] == "fitted: Q, R"
    held_out = told["result"]["after"]["held_out"]
    assert kept["scores"]["log_likelihood"] == pytest.approx(held_out["log_density"], rel=1e-6)
    assert kept["scores"]["rmse.rate"] == pytest.approx(held_out["states"]["rate"]["rms"], rel=1e-6)
    version = with_version(engine.twin, "found")
    assert version.tuning.get("R.winding") == pytest.approx(line["after"], rel=1e-12)

    # One edit: one revision for all entries, with which the result has become that of an older run.
    page.locator("#fit-use").click()
    settled(engine, 1)
    run = engine.revisions.runs[-1]
    assert run.number == 1
    assert {key: engine.tuning.get(key) for key in told["values"]} == told["values"]
    wait_for(lambda: page.locator("#fit-use").is_disabled())

    # What was found leaves nothing to be found.
    again = fitted(page)
    assert again["revision"] == 1 and not again["result"]["proposed"]
    assert page.locator("#fit-use.first").count() == 0

    page.keyboard.press("Escape")
    wait_for(lambda: page.evaluate("document.activeElement?.id") == "fit")
    assert page.locator("#fit-panel").is_hidden()
    page.locator("body").press("u")
    settled(engine, 2)
    assert engine.tuning.get("R.winding") == WRONG


def test_a_fit_shows_its_progress_while_the_page_is_used_and_stops_with_its_best_values(page, session, halted):
    page.locator("#fit").click()
    page.locator("#fit-begin").click()
    assert halted.reached.wait(LIMIT_S)
    progress = page.locator("#fit-panel .progress")
    wait_for(lambda: "Best so far: +" in progress.inner_text())
    assert re.fullmatch(r"about .+ left, .+ so far", progress.locator("output").inner_text())
    assert re.search(r"Best so far: \+[\d.]+ on the fitted blocks \([QR]\.\w+ \S+ -> \S+, ", progress.inner_text())
    assert 0.0 < page.evaluate("document.querySelector('#fit-panel progress').value") < 1.0
    assert re.fullmatch(r"Fit \d+ %", page.locator("#fit").inner_text())
    # An edit meanwhile is folded at once.
    assert page.evaluate("window.nisus.link.ask('SetTuning', {key: 'R.winding', value: 9})") is None
    settled(session.engine, 1)

    page.locator("#fit-cancel").click()
    halted.released.set()
    wait_for(lambda: progress.is_hidden() and verdict(page) is not None)
    result = page.locator("#fit-panel .result").inner_text()
    assert "Ended early: these are the best values so far" in result and "R.winding" in result


def test_single_entries_are_fitted_alone(page, session):
    page.locator("#fit").click()
    page.locator("#fit-panel .groups label", has_text="Q").locator("input").uncheck()
    told = fitted(page)
    assert told["wanted"] == ["R"] and [line["key"] for line in told["result"]["entries"]] == ["R.winding"]
    page.locator("#fit-panel .groups label", has_text="R").locator("input").uncheck()
    page.locator("#fit-begin").click()
    wait_for(lambda: "wanted is empty" in page.locator("#fit-panel .error").inner_text())
    page.locator("#fit-panel details.entries summary").click()
    page.locator("#fit-panel .entry-list input").first.check()
    told = fitted(page)
    assert len(told["wanted"]) == 1 and told["wanted"][0].startswith("Q.")


def test_what_runs_is_kept_compared_and_loaded_again(page, session):
    engine = session.engine
    keep_verdicts(engine.twin.path, VERDICT)
    page.get_by_role("tab", name="Runs").click()
    guarded = page.locator('.versions [data-guarded="winding"]')
    wait_for(lambda: "1 of 1 figures worse: rmse.temperature was 0.5 and is 0.6" in guarded.inner_text())
    page.get_by_role("textbox", name="Name of the version").fill("as it was")
    page.get_by_role("textbox", name="Note on the version").fill("too much noise")
    page.locator(".versions form button").click()
    row = page.locator('.versions tbody[data-version="as_it_was"]')
    wait_for(lambda: row.count() == 1)
    assert "too much noise" in row.inner_text()
    assert page.evaluate("window.nisus.link.ask('SetTuning', {key: 'R.winding', value: 9})") is None
    settled(engine, 1)

    row.get_by_role("button", name="Compare with the running tuning").click()
    wait_for(lambda: "R.winding" in row.inner_text())
    assert row.locator("table tbody tr").all_inner_texts() == ["R.winding\t100\t9"]

    row.get_by_role("button", name="Load").click()
    settled(engine, 2)
    wait_for(lambda: engine.tuning.get("R.winding") == WRONG)
    assert engine.tuning.name == "as_it_was" and engine.revisions.runs[-1].number == 2
    wait_for(lambda: row.get_attribute("data-running") == "true")
    # A name that is taken is refused, and it says why.
    page.get_by_role("textbox", name="Name of the version").fill("as it was")
    page.locator(".versions form button").click()
    wait_for(lambda: "there is a version of that name" in page.locator(".versions .error").last.inner_text())
