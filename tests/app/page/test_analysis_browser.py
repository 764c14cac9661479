"""What if and Diagnose in headless Chromium: they draw, follow what is asked, and rest while hidden."""

import pytest

from app.cli.run import live_source
from app.session import Page, Session
from app.twin.twin import load_twin
from tests.app.scripted import row_count, wait_for

pytestmark = pytest.mark.browser

FLAGS = (
    "--headless=new --no-sandbox --disable-gpu --enable-unsafe-swiftshader --disable-background-networking "
    "--disable-component-update --disable-sync --no-first-run --disable-quic"
).split()
PATIENCE = 120.0
"""Seconds for a step on a busy machine; a test that works takes a fraction."""


@pytest.fixture(scope="module")
def session():
    twin = load_twin("motor_can")
    made = Session(twin, live_source(twin, 1.0), page=Page(0, open_browser=False))
    made.start()
    wait_for(lambda: row_count(made.engine) > 600, PATIENCE)
    yield made
    made.stop()


@pytest.fixture(scope="module")
def page(chromium, session):
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        opened = browser.new_page(viewport={"width": 1440, "height": 900})
        opened.set_default_timeout(PATIENCE * 1000)
        opened.asked, opened.wrong = [], []
        opened.on("request", lambda request: opened.asked.append(request.url))
        opened.on("pageerror", lambda error: opened.wrong.append(str(error)))
        opened.goto(session.url)
        until(opened, "window.nisus?.drawn > 0")
        yield opened
        browser.close()


def until(page, expression):
    """Ask from outside: the page's own policy forbids the evaluation that waiting inside it would need."""
    wait_for(lambda: page.evaluate(expression), PATIENCE)


def questions(page, path):
    return sum(url.endswith(path) for url in page.asked)


def test_what_if_draws_a_fan_and_says_when_a_limit_is_reached(page, session):
    assert questions(page, "/api/forecast") == 0
    page.get_by_role("tab", name="What if").click()
    until(page, "window.nisus.forecasts > 0")
    fans = page.locator("#whatif .chart")
    assert fans.count() == 4 and fans.first.get_by_text("magnet", exact=True).is_visible()
    # The fan: blue pixels to the right of now, on every canvas.
    right = """() => [...document.querySelectorAll("#whatif canvas")].slice(0, 4).map((canvas) => {
        const { width, height } = canvas;
        const { data } = canvas.getContext("2d").getImageData(width >> 1, 0, width >> 1, height);
        let blue = 0;
        for (let k = 0; k < data.length; k += 4) if (data[k + 3] > 100 && data[k + 2] > data[k] + 60) blue++;
        return blue;
    })"""
    wait_for(lambda: min(page.evaluate(right)) > 50, PATIENCE)
    # A current ten times as strong heats the winding beyond any doubt.
    page.get_by_label("i q [A] from now on, as a number").fill("600")
    page.get_by_label("i q [A] from now on, as a number").press("Enter")
    page.get_by_label("Limit of winding °C", exact=True).fill("90")
    page.get_by_label("Limit of winding °C", exact=True).press("Enter")
    said = page.get_by_label("When winding reaches its limit")
    wait_for(lambda: said.inner_text().startswith("reaches 90 °C in "), PATIENCE)
    assert "over 99 % within 6 min" in said.inner_text()
    # And as it is now again: less hot.
    hot = page.evaluate("window.nisus.panes.whatif.found.states.winding.mean.at(-1)")
    page.get_by_label("i q as it is now").click()
    until(page, f"window.nisus.panes.whatif.found.states.winding.mean.at(-1) < {hot} - 50")
    assert session.engine.status().health != 4


def test_diagnose_draws_what_the_rows_say(page):
    page.get_by_role("tab", name="Diagnose").click()
    until(page, "window.nisus.diagnosed > 0")
    for name in ("winding", "tooth", "yoke"):
        row = page.get_by_label(f"Innovations of {name}", exact=True)
        assert row.locator("svg").count() == 3 and row.locator("figcaption").count() == 3
        assert "good: " in row.locator("figcaption").first.inner_text()
        assert row.locator("svg rect.bar").count() > 5 and row.locator("svg line.stem").count() == 50
    assert page.locator("#diagnose svg.map rect").count() == 16
    # What takes many folds comes later.
    wait_for(lambda: page.get_by_label("Smallest visible faults", exact=True).count() == 1, PATIENCE)
    wait_for(lambda: page.locator("#diagnose .shares tr").count() == 4, PATIENCE)
    wait_for(lambda: "µs" in page.locator("#diagnose .summary").inner_text(), PATIENCE)


def test_nothing_is_asked_while_both_are_hidden(page):
    page.get_by_role("tab", name="Charts").click()
    until(page, "!('whatif' in window.nisus.link.lanes) && !window.nisus.panes.whatif.busy")
    asked = [questions(page, path) for path in ("/api/forecast", "/api/diagnose")]
    drawn = page.evaluate("window.nisus.drawn")
    # Long enough for several of either, by what the charts have drawn meanwhile at ten a second at most.
    until(page, f"window.nisus.drawn > {drawn} + 60")
    assert [questions(page, path) for path in ("/api/forecast", "/api/diagnose")] == asked
    assert page.wrong == []
