"""Runs and curves on the page: pinned, seen over the charts, taken away; a knob's curve against folds of its own."""

import re

import numpy as np
import pytest

from estimators.fold import fold
from estimators.log import Log
from estimators.track import GATED, USED
from tests.app.scripted import pull_all
from tests.app.web.page.browsed import pixels, running, settled, until
from tests.waiting import wait_for

pytestmark = pytest.mark.browser

PINNED = (176, 51, 143)
"""The colour of the first place, in the light theme: app/web/page/chart.css, --pin-0."""


@pytest.fixture
def session():
    with running("motor_winding") as session:
        yield session


def coloured(page, selector, colour=PINNED):
    """Pixels of a colour in an element."""
    return int(np.sum(np.abs(pixels(page, selector) - colour).sum(axis=2) < 60))


def test_pin_overlay_and_unpin(page, session):
    engine = session.engine
    page.get_by_role("tab", name="Runs").click()
    first = engine.revisions.runs[-1].number
    page.get_by_role("button", name=f"Pin run {first}", exact=True).click()
    wait_for(lambda: engine.revisions.find(first).pinned)
    wait_for(lambda: coloured(page, "#charts") == 0)

    page.get_by_role("button", name=f"Menu of run {first}", exact=True).click()
    page.get_by_role("menuitem", name="Name and note").click()
    name = page.get_by_role("textbox", name=f"Name of run {first}")
    name.fill("as it was")
    name.press("Enter")
    wait_for(lambda: engine.revisions.find(first).name == "as it was")

    # Another filter tuning: the pinned run stays where it was, beside the new estimate.
    knob = page.locator('[data-key^="Q."] input[type=text]').first
    knob.fill("100")
    knob.press("Enter")
    settled(engine, first + 1)
    wait_for(lambda: coloured(page, "#charts article") > 100)
    wait_for(lambda: coloured(page, ".chart.difference .plot") > 100)
    wait_for(lambda: "as it was" in page.locator(".pins").inner_text())
    # Of the rate, which nobody measures.
    kept, now = engine.revisions.find(first).track.track.mean[-1, 1], pull_all(engine).track.mean[-1, 1]
    difference = page.locator(".pins output")
    difference.filter(has_text=re.compile(r"\d")).wait_for()
    wait_for(lambda: float(difference.inner_text()) == pytest.approx(kept - now, rel=0.05))

    # The table has a score for both, and marks the better one; the change has its values and their unit.
    row = page.locator(f'tbody[data-number="{first}"]')
    wait_for(lambda: row.locator(".scores td").count() == 6)
    page.locator(".runs .best").first.wait_for()
    changed = page.locator(f'tbody[data-number="{first + 1}"] .what').inner_text()
    unit = next(item.unit for item in engine.tuning.items() if item.key == "Q.temperature")
    assert changed.startswith(f"Q.temperature 0.01 → 100 {unit}")
    assert page.locator("#legend li").first.inner_text() == f"run {first}: as it was"

    # B goes back to it, and B again to the other.
    page.locator("body").press("b")
    settled(engine, first + 2)
    assert engine.status().tuning is engine.revisions.find(first).tuning
    wait_for(lambda: page.evaluate("window.nisus.link.status.runs.last") == first + 1)
    page.locator("body").press("b")
    settled(engine, first + 3)
    assert engine.status().tuning.q[0] == 100.0

    page.locator(".pins").get_by_role("button", name=f"Unpin run {first}").click()
    wait_for(lambda: not any(run.pinned for run in engine.revisions.runs))
    wait_for(lambda: page.locator(".chart.difference").is_hidden())
    wait_for(lambda: coloured(page, "#charts") == 0)
    until(page, "Object.keys(window.nisus.link.streams).every(name => !/^(run|less) /.test(name))")


def test_a_drag_is_one_run_and_its_undo_is_every_browsers(visit, session):
    engine, page = session.engine, visit(session.url)
    other = visit(session.url)
    first, began = engine.revisions.runs[-1].number, engine.tuning.q[0]
    slider = page.locator('[data-key^="Q."] input[type=range]').first
    slider.hover()  # Waits until its place is final.
    page.mouse.down()
    box = slider.bounding_box()
    across = lambda share: page.mouse.move(box["x"] + share * box["width"], box["y"] + box["height"] / 2)  # noqa: E731
    for step in range(1, 17):
        # Each value is folded before the next: without a gesture they were 16 runs.
        before = engine.status().revision
        across(0.5 + 0.02 * step)
        wait_for(lambda before=before: engine.status().revision > before)
    page.mouse.up()
    until(page, "document.getElementById('undo').title.startsWith('Undo Q.')")
    settled(engine)
    last = engine.tuning.q[0]
    assert last > 5 * began and len(engine.revisions.runs) == 2
    (change,) = engine.revisions.runs[-1].changes
    assert (change.before, change.after) == (began, last) and engine.status().revision >= first + 16

    # Keys in quick succession are one run too.
    slider.focus()
    for _ in range(4):
        slider.press("ArrowLeft")
    until(page, f"window.nisus.link.status.edits.undo.includes(' {last:.6g} →')")
    settled(engine)
    assert len(engine.revisions.runs) == 3

    # The other browser takes both back, and this one makes the first again.
    until(other, "!document.getElementById('undo').disabled")
    other.locator("body").press("u")
    wait_for(lambda: engine.tuning.q[0] == last)
    other.locator("body").press("u")
    wait_for(lambda: engine.tuning.q[0] == began)
    until(page, "document.getElementById('undo').disabled && !document.getElementById('redo').disabled")
    page.locator("body").press("U")
    wait_for(lambda: engine.tuning.q[0] == last)


def likelihood(track):
    used = track.verdict == USED
    assert not np.any(track.verdict == GATED)
    return track.log_likelihood[used].sum()


def test_the_curve_around_a_knob_shows_the_likeliest_value(page, session):
    engine = session.engine
    key = next(item.key for item in engine.tuning.items() if item.key.startswith("R."))
    label = page.locator(f'[data-key="{key}"] label')
    label.focus()
    label.press("Enter")
    curve = page.locator(f'[data-key="{key}"] .around')
    wait_for(lambda: curve.get_attribute("data-done") == "true")
    assert curve.locator("circle").count() == 7

    status, model, log = engine.status(), engine.model, Log.of(engine.model)
    log.extend(pull_all(engine).events)
    value = status.tuning.get(key)
    values = [value * factor for factor in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)]
    ungated = [status.tuning.set(key, item).set("gate", None) for item in values]
    best = values[int(np.argmax([likelihood(fold(status.estimator, model, tuning, log)) for tuning in ungated]))]
    said = curve.locator("output").inner_text()
    assert float(said.split("likeliest at ")[1].split(",")[0]) == pytest.approx(best, rel=0.01)

    # What the data say is offered last, once it is known: a button more between reading and pressing would be another.
    until(page, "window.nisus.tune.around.revision !== undefined")
    take = curve.locator(".takes button:not([hidden])").last
    wanted = float(take.inner_text().split()[-1])
    take.click()
    wait_for(lambda: engine.status().tuning.get(key) == pytest.approx(wanted, rel=0.01))


def test_the_smoothed_estimate_is_drawn_while_it_is_on(page):
    chart, colour = "#charts .chart canvas", (38, 76, 70)  # app/web/page/chart.css, --smoothed
    before = coloured(page, chart, colour)
    button = page.locator("#smoothed")
    button.click()
    assert button.get_attribute("aria-pressed") == "true"
    wait_for(lambda: coloured(page, chart, colour) > before + 100)
    button.click()
    wait_for(lambda: coloured(page, chart, colour) <= before + 20)
