"""On a small window and on a large one nothing is wider than the column in which it stands."""

import pytest

from tests.app.scripted import wait_for
from tests.app.web.page.browsed import PATIENCE, running, until

pytestmark = pytest.mark.browser

SIZES = ((1024, 700), (1440, 900), (2560, 1440))
FILLED = {"What if": "window.nisus.forecasts > 0", "Diagnose": "window.nisus.diagnosed > 0"}
"""By tab, whether there is something in it."""
TABS = ("Charts", "What if", "Diagnose", "Scene", "XY", "Runs", "Episodes")

WIDER = """() => {
  const found = [];
  const columns = [...document.querySelectorAll("#trust, #left, #middle, #right, #transport")];
  const name = (node) => `${node.tagName.toLowerCase()}${node.id ? "#" + node.id : ""}.${node.className?.baseVal ?? node.className}`;
  for (const column of columns) {
    const { left, right } = column.getBoundingClientRect();
    if (!column.checkVisibility({ visibilityProperty: true })) continue;
    for (const node of column.querySelectorAll("*")) {
      if (!node.checkVisibility({ visibilityProperty: true })) continue;
      if (node.matches(".knob input[type=text]") && node.scrollWidth > node.clientWidth) found.push(`${name(node)} hides the end of ${node.value}`);
      const style = getComputedStyle(node);
      // Nothing is to be scrolled sideways to be seen.
      if (/auto|scroll/.test(style.overflowX) && node.scrollWidth > node.clientWidth + 1) found.push(`${name(node)} scrolls: ${node.scrollWidth} > ${node.clientWidth}`);
      const place = node.getBoundingClientRect();
      const cell = node.parentElement.closest("td, th");
      if (cell && place.width && place.right > cell.getBoundingClientRect().right + 1) found.push(`${name(node)} leaves its cell`);
      if (!place.width || !place.height || (place.right <= right + 1 && place.left >= left - 1)) continue;
      // What is cut off on purpose, as with an ellipsis, is within its own frame.
      let cut = node.parentElement;
      while (cut !== column && getComputedStyle(cut).overflowX === "visible") cut = cut.parentElement;
      if (cut === column) found.push(`${name(node)} ${Math.round(place.left)}–${Math.round(place.right)} in ${name(column)} ${Math.round(left)}–${Math.round(right)}`);
    }
  }
  const { scrollWidth, clientWidth } = document.documentElement;
  if (scrollWidth > clientWidth) found.push(`the page: ${scrollWidth} > ${clientWidth}`);
  return found;
}"""  # noqa: E501


@pytest.mark.parametrize("name", ["motor_can", "agv_corridor", "battery_pack", "lorenz96"])
def test_nothing_is_wider_than_its_column(name, visit):
    with running(name, 4.0) as session:
        page = visit(session.url, ready="window.nisus?.drawn > 3")
        # Rows with all their buttons: a run before the one that runs, and both have a name.
        page.evaluate("window.nisus.link.ask('UseSensor', {name: window.nisus.model.sensors[0], used: false})")
        wait_for(lambda: session.engine.status().revision > 0, PATIENCE)
        page.evaluate("window.nisus.link.ask('Note', {number: 0, name: 'a name of some length', note: ''})")
        # A value as long as they come.
        key = page.evaluate("document.querySelector('.knob[data-key^=\"Q.\"]').dataset.key")
        assert page.evaluate("(key) => window.nisus.link.ask('SetTuning', { key, value: 1.008e-12 })", key) is None
        until(page, "document.querySelector('.knob[data-key^=\"Q.\"] input[type=text]').value === '1.008e-12'")
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            for tab in TABS:
                page.get_by_role("tab", name=tab, exact=True).click()
                if tab == "Runs":
                    wait_for(
                        lambda: page.locator(".runs .scores").count() == len(session.engine.revisions.runs), PATIENCE
                    )
                if tab in FILLED:
                    until(page, FILLED[tab])
                # Laid out, and drawn in that layout.
                page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
                assert page.evaluate(WIDER) == [], (width, tab)
            if width < 1100:
                page.get_by_role("button", name="Tune").first.click()
                assert page.evaluate(WIDER) == [], (width, "Tune")
                page.get_by_role("button", name="Tune").first.click()
