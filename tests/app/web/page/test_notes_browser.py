"""Notes of users on the page: written by a gesture, seen by every browser, changed and deleted, in link and report."""

import re

import numpy as np
import pytest

from tests.app.web.page.browsed import pixels, running, until
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
    from app.live.commands import Annotate

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
