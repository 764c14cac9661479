"""Notes of users on the page: written by a gesture, seen by every browser, changed and deleted, in link and report.

Runs and curves on it: pinned, seen over the charts, taken away; a knob's curve against folds of its own.
"""

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


@pytest.fixture
def session():
    with running("motor_winding") as session:
        yield session


def at(page, share, chart=1):
    """A place in the plot of a chart, by its share of the width: x and y in px, and its time, s."""
    box = page.locator("#charts .u-over").nth(chart).bounding_box()
    low, high = page.evaluate("window.nisus.charts.range")
    return round(box["x"] + share * box["width"]), round(box["y"] + box["height"] / 2), low + share * (high - low)


def dotted(page, left):
    """Share of the pixels of the second chart's column at a place that have the colour of text."""
    box = page.locator("#charts .u-over").nth(1).bounding_box()
    columns = pixels(page, "#charts .u-over >> nth=1")[:, round(left - box["x"]) - 1 : round(left - box["x"]) + 2]
    return float(np.max(np.mean(np.abs(columns - (0x14, 0x20, 0x2F)).sum(axis=2) < 90, axis=0)))


def texts(page):
    """Texts of the notes as the panel lists them."""
    return page.locator(".notes li .at span").all_inner_texts()


def test_a_note_is_written_at_a_moment_and_every_browser_has_it(visit, session):
    engine, page, other = session.engine, visit(session.url), visit(session.url)
    for each in (page, other):
        each.get_by_role("tab", name="Episodes").click()
    left, top, time = at(page, 0.3)
    low = page.evaluate("window.nisus.charts.range[0]")
    before = dotted(page, left)
    page.mouse.move(left, top)
    page.keyboard.down("Alt")
    # Dragged, it zooms as ever.
    page.mouse.down()
    page.mouse.move(left + 60, top, steps=4)
    page.mouse.up()
    until(page, "!window.nisus.view.following")
    assert page.locator("#note").is_hidden()
    page.evaluate("window.nisus.view.follow()")
    until(page, f"window.nisus.charts.range[0] === {low}")
    page.mouse.move(left, top)
    page.mouse.click(left, top)
    page.keyboard.up("Alt")
    field = page.get_by_role("textbox", name="Note")
    field.fill("fan off")
    field.press("Enter")
    wait_for(lambda: engine.annotations.notes)
    (note,) = engine.annotations.notes
    low, high = page.evaluate("window.nisus.charts.range")
    pixel = (high - low) / page.locator("#charts .u-over").nth(1).bounding_box()["width"]
    assert (note.t - engine.span()[0]) * 1e-9 == pytest.approx(time, abs=pixel) and note.text == "fan off"
    # Drawn through the charts, its text in the first one; listed in both browsers.
    wait_for(lambda: texts(page) == texts(other) == ["fan off"])
    until(page, "window.nisus.charts.charts[0].written.includes('fan off')")
    page.mouse.move(left + 200, top)
    wait_for(lambda: dotted(page, left) > before + 0.1)
    assert field.is_hidden()

    # N writes one where the pointer is; without a text it says why not.
    left, top, time = at(other, 0.6)
    other.mouse.move(left, top)
    until(other, "window.nisus.charts.charts[1].plot.cursor.left > 0")
    other.keyboard.press("n")
    field = other.get_by_role("textbox", name="Note")
    field.press("Enter")
    wait_for(lambda: "write 1 to 500" in other.locator("#note .error").inner_text())
    field.fill("torque step")
    field.press("Enter")
    wait_for(lambda: texts(page) == ["fan off", "torque step"])
    assert (engine.annotations.find(2).t - engine.span()[0]) * 1e-9 == pytest.approx(time, abs=pixel)

    # Its entry leads there; the text can be changed, and each can be deleted.
    page.get_by_role("button", name=re.compile("torque step")).click()
    until(page, f"Math.abs(window.nisus.view.at - {(engine.annotations.find(2).t - engine.span()[0]) * 1e-9}) < 1e-6")
    page.get_by_role("button", name=re.compile("^Edit the note")).last.click()
    field = page.get_by_role("textbox", name="Note")
    assert field.input_value() == "torque step"
    field.fill("torque step to 120 Nm")
    field.press("Enter")
    wait_for(lambda: texts(other) == ["fan off", "torque step to 120 Nm"])
    page.get_by_role("button", name=re.compile("^Edit the note")).first.click()
    page.get_by_role("textbox", name="Note").fill("not this")
    page.get_by_role("textbox", name="Note").press("Escape")
    other.get_by_role("button", name=re.compile("^Delete the note")).first.click()
    wait_for(lambda: texts(page) == ["torque step to 120 Nm"])
    assert [note.text for note in engine.annotations.notes] == ["torque step to 120 Nm"]


def test_a_link_to_the_moment_of_a_note_and_the_report_show_it(visit, session, tmp_path):
    from app.engine.commands import Annotate

    engine, page = session.engine, visit(session.url)
    first = engine.span()[0] * 1e-9
    for second, text in ((50.0, "a first note, of some length, before the other one"), (52.0, "fan off")):
        engine.submit(Annotate(text, first + second))
    page.get_by_role("tab", name="Episodes").click()
    wait_for(lambda: len(texts(page)) == 2)
    # The first has no room before the second, unless it is looked at.
    until(page, "window.nisus.charts.charts[0].written.join() === 'fan off'")
    page.get_by_role("button", name=re.compile("a first note")).click()
    page.locator("body").press("l")
    until(page, "location.hash.includes('at=')")
    later = visit(page.evaluate("location.href"), beside=page)
    until(
        later, "window.nisus.charts.charts[0].written.at(-1) === 'a first note, of some length, before the other one'"
    )
    assert later.evaluate("window.nisus.view.at") == pytest.approx(50.0, abs=1e-6)

    html = page.evaluate("fetch('/api/report.html').then((answer) => answer.text())")
    (tmp_path / "report.html").write_text(html, encoding="utf-8")
    report = page.context.new_page()
    report.goto((tmp_path / "report.html").as_uri())
    report.get_by_role("heading", name="Notes").wait_for()
    assert report.get_by_role("row", name="0:52 fan off").is_visible()
    drawings = report.locator("img.paper")
    wait_for(lambda: drawings.count() > 2)
    assert all("fan%20off" in drawing.get_attribute("src") for drawing in drawings.all())


PINNED = (176, 51, 143)
"""The colour of the first place, in the light theme: app/web/page/chart.css, --pin-0."""


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
    unpin = page.wait_for_selector(f".pins [title='Unpin run {first}']")

    page.get_by_role("button", name=f"Menu of run {first}", exact=True).click()
    page.get_by_role("menuitem", name="Name and note").click()
    name = page.get_by_role("textbox", name=f"Name of run {first}")
    name.fill("as it was")
    name.press("Enter")

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
    until(page, f"window.nisus.link.status.runs.last === {first + 1}")
    page.locator("body").press("b")
    settled(engine, first + 3)
    assert engine.status().tuning.q[0] == 100.0

    # A list that changes keeps its buttons: a press on one that is replaced is lost.
    unpin.click()
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
