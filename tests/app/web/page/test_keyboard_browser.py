"""In headless Chromium: all that can be done is reached by the keyboard and has a name, and all text can be read."""

import re

import numpy as np
import pytest
from playwright.sync_api import Error

from tests.app.web.page.browsed import running, until
from tests.app.web.page.test_colours import TEXT, contrast, over
from tests.waiting import wait_for

pytestmark = pytest.mark.browser

MAX_TAB_PRESSES = 400
"""Presses of Tab until every control had its turn, at most."""

CONTROLS = """(() => {
  const all = document.querySelectorAll(
    "button, select, input, textarea, a[href], summary, [tabindex='0'], [role=slider]",
  );
  const seen = (node) => node.checkVisibility({ visibilityProperty: true }) && !node.closest("[inert]");
  const usable = (node) => !node.disabled && seen(node);
  return [...all].filter(usable).map((node) => {
    node.dataset.testNumber ??= String((window.testCount = (window.testCount ?? 0) + 1));
    const list = node.getAttribute("role") === "tab" ? node.parentElement.id : null;
    return [node.dataset.testNumber, list, node.outerHTML.slice(0, 160)];
  });
})()"""

TEXTS = """(() => {
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const seen = [];
  while (walker.nextNode()) {
    const node = walker.currentNode.parentElement;
    const text = walker.currentNode.textContent.trim();
    if (!text || !node.checkVisibility({ visibilityProperty: true, opacityProperty: true })) continue;
    if (node.closest(":disabled, [aria-hidden=true], option, script")) continue;
    const layers = [];
    for (let at = node; at; at = at.parentElement) layers.push(getComputedStyle(at).backgroundColor);
    seen.push([text.slice(0, 40), getComputedStyle(node).color, layers]);
  }
  return seen;
})()"""


@pytest.fixture(scope="module")
def session():
    # It goes on through all tests: what has ended cannot be paused.
    with running("motor_winding", 4.0, **{"source.duration": "1000000"}) as session:
        yield session


def opened(visit, session, scheme="light"):
    page = visit(session.url, scheme=scheme)
    page.get_by_text("Process noise Q").wait_for()
    return page


def names_of(page):
    """What Chromium tells a screen reader of each numbered control."""
    client = page.context.new_cdp_session(page)
    root = client.send("DOM.getDocument", {"depth": 0})["root"]["nodeId"]
    found = {}
    for node in client.send("DOM.querySelectorAll", {"nodeId": root, "selector": "[data-test-number]"})["nodeIds"]:
        attributes = client.send("DOM.getAttributes", {"nodeId": node})["attributes"]
        number = dict(zip(attributes[::2], attributes[1::2], strict=True))["data-test-number"]
        told = client.send("Accessibility.getPartialAXTree", {"nodeId": node, "fetchRelatives": False})["nodes"][0]
        found[number] = told.get("name", {}).get("value", "")
    return found


def walked(page):
    """The numbers of the controls that Tab comes to, until it has been everywhere."""
    reached = []
    page.evaluate("document.activeElement?.blur()")
    for _ in range(MAX_TAB_PRESSES):
        page.keyboard.press("Tab")
        number = page.evaluate("document.activeElement?.dataset?.testNumber ?? null")
        if number is not None and reached and number == reached[0]:
            break
        if number is not None and number not in reached:
            reached.append(number)
    return set(reached)


@pytest.mark.parametrize("show", [[], ["Runs", "What if"], ["Episodes", "Diagnose"]])
def test_every_control_is_reached_by_tab_and_has_a_name(visit, session, show):
    page = opened(visit, session)
    # Paused, nothing comes or goes on the way; and the scene is Viser's, with focus of its own.
    page.get_by_role("tab", name="XY").click()
    page.get_by_label("Pause or continue").click()
    wait_for(lambda: session.engine.status().paused)
    try:
        for tab in show:
            page.get_by_role("tab", name=tab, exact=True).click()
        page.evaluate("for (const item of document.querySelectorAll('#left details')) item.open = true")

        def undisturbed_walk():
            """Controls, their names and those that were reached, once none came or went on the way."""
            controls = page.evaluate(CONTROLS)
            try:
                names, reached = names_of(page), walked(page)
            except Error:  # the document has lost one of them
                return False
            same = [number for number, *_ in controls] == [number for number, *_ in page.evaluate(CONTROLS)]
            return same and (controls, names, reached)

        controls, names, reached = wait_for(undisturbed_walk)
        assert len(controls) > 40
        nameless = [html for number, _, html in controls if not names.get(number, "").strip()]
        assert nameless == []
        # One tab of a list has its turn, and arrows go on from it.
        listed = {tabs for number, tabs, _ in controls if tabs and number in reached}
        missed = [html for number, tabs, html in controls if number not in reached and tabs not in listed]
        assert missed == []
        first = page.locator("#middle-tabs [aria-selected=true]")
        first.focus()
        chosen = first.inner_text()
        page.keyboard.press("ArrowRight")
        until(page, f"document.activeElement.textContent !== {chosen!r}")
        assert page.evaluate("document.activeElement.getAttribute('aria-selected')") == "true"
    finally:
        page.get_by_label("Pause or continue").click()
        wait_for(lambda: not session.engine.status().paused)


OUTLINE = """() => {
  const seen = (node) => node.checkVisibility({ visibilityProperty: true });
  const headings = [...document.querySelectorAll("h1, h2, h3, h4, h5, h6")].filter(seen);
  const panels = [...document.querySelectorAll("#tune, #faults, [role=tabpanel]")].filter(seen);
  const before = (panel) => panel.previousElementSibling?.matches("h2") || panel.querySelector("h2");
  const numbers = ["aria-valuemin", "aria-valuemax", "aria-valuenow"];
  const sliders = [...document.querySelectorAll("[role=slider], [role=separator][tabindex]")].filter(seen);
  return {
    levels: headings.map((node) => Number(node.localName[1])),
    untitled: panels.filter((panel) => !before(panel)).map((panel) => panel.id),
    sliders: sliders.map((node) => numbers.map((name) => parseFloat(node.getAttribute(name)))),
    unnamed: [...document.querySelectorAll("[role=tabpanel]")].filter((panel) => !document.getElementById(panel.getAttribute("aria-labelledby"))).map((panel) => panel.id),
  };
}"""  # noqa: E501


@pytest.mark.parametrize("tabs", [["XY"], ["Runs", "What if"], ["Episodes", "Diagnose"]])
@pytest.mark.parametrize("width", [1000, 1440])
def test_headings_form_an_outline_and_sliders_have_values(visit, session, tabs, width):
    page = visit(session.url, size=(width, 900))
    page.locator("#faults details").first.wait_for(state="attached")
    for tab in tabs:
        page.get_by_role("tab", name=tab, exact=True).click()
    wait_for(lambda: page.locator("#diagnose h2, #diagnose article, #whatif article, #xy canvas, #charts").count() > 0)
    found = page.evaluate(OUTLINE)
    levels = found["levels"]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after <= level + 1 for level, after in zip(levels, levels[1:], strict=False))
    assert found["untitled"] == [] and found["unnamed"] == []
    assert found["sliders"] and all(low <= now <= high for low, high, now in found["sliders"])


def test_the_time_slider_is_moved_by_keys(visit, session):
    page = opened(visit, session)
    track = page.get_by_role("slider", name="Time: health and events")
    until(page, "window.nisus.charts.newest > 2")
    track.focus()
    page.keyboard.press("Home")
    until(page, "window.nisus.view.at !== null && document.getElementById('timeline').ariaValueNow === '0'")
    page.keyboard.press("End")
    until(page, "window.nisus.view.following")


def color(text):
    """Parse a computed colour: rgb(a), or color(srgb …) of a mixture."""
    numbers = [float(part) for part in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", text.removeprefix("color(srgb"))]
    parts = np.array(numbers[:3]) / (1.0 if text.startswith("color(srgb") else 255.0)
    return np.append(parts, numbers[3] if len(numbers) > 3 else 1.0)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("tabs", [["Runs"], ["Episodes", "What if"], ["XY", "Diagnose"]])
def test_all_text_can_be_read(visit, session, scheme, tabs):
    """As Chromium computes it: the colour of each text, on all backgrounds beneath it."""
    page = opened(visit, session, scheme)
    for tab in tabs:
        page.get_by_role("tab", name=tab, exact=True).click()
    wait_for(lambda: page.evaluate("document.getElementById('health').textContent.length > 3"))
    wait_for(lambda: len(page.evaluate(TEXTS)) > 60)
    texts = page.evaluate(TEXTS)
    faint = []
    for text, ink, layers in texts:
        ground = color("rgb(255, 255, 255)")
        for layer in reversed(layers):
            ground = over(color(layer), ground)
        found = contrast(over(color(ink), ground), ground)
        if found < TEXT:
            faint.append(f"{text!r}: {found:.2f}")
    assert faint == []
