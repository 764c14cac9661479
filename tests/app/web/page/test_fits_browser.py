"""On a small window and on a large one nothing is wider than the column in which it stands."""

import pytest

from tests.app.web.page.browsed import running, until
from tests.waiting import wait_for

pytestmark = pytest.mark.browser

SIZES = ((1024, 700), (1440, 900), (2560, 1440))
FILLED = {"What if": "window.nisus.forecasts > 0", "Diagnose": "window.nisus.diagnosed > 0"}
"""By tab, whether there is something in it."""
ROWS_DRAWN = "window.nisus?.drawn > 0 && window.nisus.charts.live.x.length > 20"
"""Of a source that may have ended meanwhile, which is drawn once."""
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


@pytest.fixture(scope="module")
def picture():
    with running("lorenz96", 4.0) as session:
        yield session


def laid_out(page):
    """Wait until the page is laid out, and drawn in that layout."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


@pytest.mark.parametrize("name", ["motor_can", "battery_pack", "lorenz96"])
def test_nothing_is_wider_than_its_column(name, visit):
    with running(name, 4.0) as session:
        page = visit(session.url, ready=ROWS_DRAWN)
        # Rows with all their buttons: a run before the one that runs, and both have a name.
        page.evaluate("window.nisus.link.ask('UseSensor', {name: window.nisus.model.sensors[0], used: false})")
        wait_for(lambda: session.engine.status().revision > 0)
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
                    wait_for(lambda: page.locator(".runs .scores").count() == len(session.engine.revisions.runs))
                if tab in FILLED:
                    until(page, FILLED[tab])
                laid_out(page)
                assert page.evaluate(WIDER) == [], (width, tab)
            if width < 1100:
                page.get_by_role("button", name="Tune").first.click()
                assert page.evaluate(WIDER) == [], (width, "Tune")
                page.get_by_role("button", name="Tune").first.click()


def test_the_nis_is_seen_on_a_low_window_and_the_choice_of_the_error_is_whole(visit):
    with running("battery_pack", 60.0) as session:
        page = visit(session.url, ready=ROWS_DRAWN, size=(1440, 480))
        charts = page.locator("#charts .chart:not([data-kind=nis]):visible")
        above = sum(charts.nth(k).bounding_box()["height"] for k in range(3))
        assert above > page.locator("#charts").evaluate("(node) => node.clientHeight") - 60
        box, panel = (page.locator(name).first.bounding_box() for name in ("#charts > [data-kind=nis]", "#charts"))
        assert box["y"] >= panel["y"] and box["y"] + box["height"] <= panel["y"] + panel["height"] + 1
        page.get_by_role("tab", name="Runs").click()
        select = page.get_by_label("State or sensor of the error")
        # As wide as its longest text. Scores that arrive replace the panel, and with it the node that is asked.
        wait_for(lambda: select.evaluate("(node) => node.scrollWidth <= node.clientWidth && node.clientWidth > 100"))


def test_a_narrow_scale_has_two_ends(visit, picture):
    page = visit(picture.url, ready=ROWS_DRAWN)
    ends = page.evaluate("""(() => {
      const chart = window.nisus.charts.charts.find((chart) => chart.what.ramp);
      chart.what.ramp = () => ({ colors: [], low: 25.1034, high: 25.1287 });
      chart.scale();
      return [...chart.ramp.children].map((node) => node.textContent);
    })()""")
    assert ends[0] == "25.103" and ends[2].startswith("25.129")


SIDE = {"Scene": "scene", "XY": "xy", "Runs": "runs", "Episodes": "episodes"}


def test_below_1100_px_the_right_column_becomes_tabs(visit, session):
    page = visit(session.url, size=(1440, 900))
    assert page.locator("#side-tabs [role=tab]").count() == len(SIDE)
    wide = page.locator("#charts").bounding_box()["width"]
    page.get_by_role("tab", name="Episodes").click()
    page.set_viewport_size({"width": 1000, "height": 800})
    page.locator("#middle-tabs #tab-episodes").wait_for()
    assert page.locator("#side-tabs [role=tab]").count() == 0 and page.locator("#charts").is_visible()
    assert page.locator("#charts").bounding_box()["width"] == 1000 > wide
    for name, panel in SIDE.items():
        page.get_by_role("tab", name=name, exact=True).click()
        shown = page.locator("#middle > [role=tabpanel]:visible")
        assert shown.count() == 1 and shown.get_attribute("id") == panel
        assert shown.bounding_box()["width"] > 650 and page.locator("#middle-tabs [aria-selected=true]").count() == 1
    # From the strip too, and by the arrows; back in a wide window, the tab that was shown stays.
    page.locator("#health").click()
    assert page.locator("#episodes").is_visible()
    page.keyboard.press("y")
    page.locator("#tab-xy").focus()
    page.keyboard.press("ArrowRight")
    assert page.locator("#runs").is_visible()
    page.set_viewport_size({"width": 1440, "height": 900})
    page.locator("#side-tabs #tab-runs").wait_for()
    assert page.locator("#right #runs").is_visible() and page.locator("#charts").is_visible()
    until(page, "window.nisus.charts.visible")


@pytest.mark.parametrize("name", ["gripper_contact", "motor_can", "agv_corridor"])
def test_a_phone_shows_health_cause_and_charts_without_controls(name, visit):
    """At 390 px nothing leaves the screen, and no control changes the session."""
    with running(name, 4.0) as session:
        page = visit(session.url, size=(390, 844), ready=ROWS_DRAWN)
        for tab in ("Charts", "Diagnose", "Scene", "XY", "Episodes"):
            page.get_by_role("tab", name=tab, exact=True).click()
            if tab in FILLED:
                until(page, FILLED[tab])
            laid_out(page)
            assert page.evaluate(WIDER) == [], tab
        page.get_by_role("tab", name="Charts").click()
        assert page.locator("#health").is_visible() and page.locator("#lights").is_visible()
        for control in ("#tune", "#faults", "#estimator", "#record", "#pause", "#speed", "#tab-runs", "#tab-whatif"):
            assert page.locator(control).is_hidden(), control
        # At one moment: the strip is as high as its cause.
        boxes = page.evaluate(
            "[...document.querySelectorAll('#charts .chart')].map((n) => n.getBoundingClientRect().toJSON())"
        )
        boxes = sorted((box for box in boxes if box["height"]), key=lambda box: box["y"])
        assert len(boxes) > 2 and all(box["width"] == 390 and box["height"] >= 130 for box in boxes)
        assert all(a["y"] + a["height"] <= b["y"] + 1 for a, b in zip(boxes, boxes[1:], strict=False))
        # The cause is read in full.
        cause = "yoke reads 6.1 °C above its prediction since 1:02: check the wiring of the sensor or hold it out"
        page.evaluate("(text) => (document.getElementById('cause').textContent = text)", cause)
        assert page.locator("#cause").evaluate("(node) => node.scrollHeight - node.clientHeight") <= 1


LEGEND = """() => {
  const { charts } = window.nisus.charts, nodes = [...document.querySelectorAll("#legend li")];
  const seen = nodes.filter((node) => {
    const box = node.getBoundingClientRect(), frame = node.closest("nav").getBoundingClientRect();
    return box.width && box.left >= frame.left && box.right <= frame.right + 1 && box.bottom <= frame.bottom + 1;
  });
  const key = ([, style]) => (style.ring ? `${style.tone} ring` : style.tone);
  const drawn = new Set(charts.filter((chart) => !chart.node.hidden).flatMap((chart) => chart.legend.map(key)));
  drawn.delete("bound");
  const explained = nodes.every((node) => node.textContent && node.title);
  return [[...drawn], seen.map((node) => node.dataset.key), explained];
}"""


def test_the_legend_has_every_mark_of_the_charts_and_no_other(visit):
    with running("motor_can", 4.0, **{"gate.probability": "0.9"}) as session:
        page = visit(session.url, ready=ROWS_DRAWN)
        page.evaluate("window.nisus.link.ask('UseSensor', {name: 'yoke', used: false})")
        marks = {"estimate", "band", "truth", "reading", "reading ring", "refused", "previous", "quiet", "bounds"}

        def complete():
            drawn, seen, explained = page.evaluate(LEGEND)
            extra = set(seen) - {"episode-strip", "outside"}
            return marks <= set(drawn) and set(drawn) == extra and explained

        for width in (1000, 1440, 1920):
            page.set_viewport_size({"width": width, "height": 900})
            laid_out(page)
            wait_for(complete)


def test_a_picture_has_a_colour_bar_with_its_ends(visit, picture):
    """The bar's ends enclose all that is drawn, and are not far beyond it; a file has the bar too."""
    page = visit(picture.url, ready=ROWS_DRAWN)
    chart = "window.nisus.charts.charts.find((chart) => chart.what.ramp)"
    low, high, least, most, legend = page.evaluate(f"""(() => {{
      const chart = {chart}, values = chart.names.flatMap((name) => chart.data[name]).filter((v) => typeof v === "number");
      const [low, , high] = [...chart.ramp.children].map((node) => parseFloat(node.textContent));
      return [low, high, Math.min(...values), Math.max(...values), chart.legend.map(([text]) => text)];
    }})()""")  # noqa: E501
    assert low <= least < most <= high and high - low < 2 * (most - least)
    assert page.locator(".ramp i").first.bounding_box()["width"] > 80
    assert len(legend) == 1 and [float(part) for part in legend[0].split(" to ")] == [low, high]
