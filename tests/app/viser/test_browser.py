"""The Viser pane in headless Chromium: what is drawn, and what a hand on the controls makes the engine do."""

import numpy as np
import pytest

from app.engine.commands import SetEstimator, SetTuning
from app.engine.engine import Engine
from app.server.private_viser import HEADER
from app.viser.view import ViserView
from estimators.log import READING, TRUTH, Events
from estimators.models import MODELS
from estimators.track import TRACKING
from tests.app.engine.test_reset import JUMP, RESET_AT, asset, stubborn
from tests.app.fake_engine import FakeEngine, events
from tests.app.scripted import Scripted, readings, wait_for
from tests.app.served import shown_twin

pytestmark = pytest.mark.browser

WINDING = MODELS["motor_winding"]
FLAGS = (
    "--headless=new --no-sandbox --disable-gpu --enable-unsafe-swiftshader --disable-background-networking "
    "--disable-component-update --disable-sync --no-first-run --disable-quic"
).split()
CHARTS = "Object.values(window.__viserTestpoints?.uplots ?? {}).map(item => item.chart)"


@pytest.fixture(scope="module")
def browser(chromium):
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def engine():
    engine = FakeEngine(WINDING, "kf")
    rng = np.random.default_rng(3)
    t = 1.0 + np.arange(60)
    truth = 40.0 + 0.1 * t
    parts = [events(WINDING, READING, 0, t, truth + rng.normal(0, 2, 60)), events(WINDING, TRUTH, 0, t, truth)]
    both = Events.concat(parts, WINDING.width)
    engine.put(both.select(np.argsort(both.t, kind="stable")))
    return engine


@pytest.fixture
def view(engine):
    view = ViserView(engine, secret="s3cret")
    view.start()
    yield view
    view.stop()


@pytest.fixture
def page(browser, view):
    context = browser.new_context(viewport={"width": 900, "height": 1000}, extra_http_headers={HEADER: "s3cret"})
    page = context.new_page()
    page.set_default_timeout(60_000)
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"http://127.0.0.1:{view.port}/")
    # The charts are drawn: uPlot found a range for the estimate and holds its sixty seconds.
    page.wait_for_function(f"{CHARTS}.length === 3 && {CHARTS}[0].data[0].length >= 60")
    # They have the data before they have a size.
    page.wait_for_function(f"{CHARTS}.every(chart => chart.ctx.canvas.width > 0)")
    yield page
    context.close()
    assert errors == []


def inputs(page):
    """What the fields of the panel show now."""
    return page.evaluate("[...document.querySelectorAll('input')].map(input => input.value)")


def test_charts_are_drawn_with_band_line_and_dots(page):
    low, high = page.evaluate(f"(() => {{ const y = {CHARTS}[0].scales.y; return [y.min, y.max]; }})()")
    assert 25.0 < low < 41.0 < 45.0 < high < 60.0
    colours = page.evaluate(
        f"""(() => {{
            const canvas = {CHARTS}[0].ctx.canvas;
            const data = {CHARTS}[0].ctx.getImageData(0, 0, canvas.width, canvas.height).data;
            const count = {{blue: 0, orange: 0, green: 0, band: 0}};
            for (let i = 0; i < data.length; i += 4) {{
                const [r, g, b, a] = data.slice(i, i + 4);
                if (a > 200 && b > 200 && r < 90) count.blue++;
                if (a > 200 && r > 220 && g > 130 && g < 190 && b < 80) count.orange++;
                if (a > 200 && g > 140 && r < 80 && b < 120) count.green++;
                if (a > 20 && a < 80 && b > r) count.band++;
            }}
            return count;
        }})()"""
    )
    assert colours["blue"] > 200 and colours["orange"] > 200 and colours["green"] > 100 and colours["band"] > 2000


def test_typed_variance_reaches_the_engine_and_the_history_is_redrawn(page, engine):
    before = page.evaluate(f"Array.from({CHARTS}[0].data[1])")
    field = page.locator("input[value='0.01']")
    field.fill("0.5")
    wait_for(lambda: engine.commands)
    assert engine.commands == [SetTuning("Q.temperature", 0.5)]
    page.wait_for_function(f"Math.max(...{CHARTS}[0].data[1]) > {max(before) + 0.1}")
    # The previous revision is there too, as it was.
    previous = page.evaluate(f"Array.from({CHARTS}[0].data[6])")
    assert np.nanmax(np.array(previous, float)) <= max(before)


def test_dragged_slider_reaches_the_engine(page, engine):
    thumb = page.get_by_role("slider").first
    box = thumb.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 31):
        page.mouse.move(x + 2 * step, y)
    page.mouse.up()
    # More commands may come while this one is looked at: what counts is where engine and panel come to agree.
    wait_for(lambda: engine.status().tuning.get("Q.temperature") > 0.05)
    wait_for(lambda: f"{engine.status().tuning.get('Q.temperature'):.4g}" in inputs(page))
    assert all(isinstance(command, SetTuning) and command.key == "Q.temperature" for command in engine.commands)


def test_chosen_estimator_reaches_the_engine(page, engine):
    page.get_by_role("combobox", name="Estimator").click()
    page.get_by_role("option", name="Unscented Kalman filter", exact=True).click()
    wait_for(lambda: engine.commands)
    assert engine.commands == [SetEstimator("ukf")]
    page.get_by_text("revision 1").wait_for()


def test_two_browsers_show_the_same(page, browser, view, engine):
    other = browser.new_context(viewport={"width": 900, "height": 1000}, extra_http_headers={HEADER: "s3cret"})
    second = other.new_page()
    second.goto(f"http://127.0.0.1:{view.port}/")
    second.wait_for_function(f"{CHARTS}.length === 3 && {CHARTS}[0].data[0].length >= 60")
    engine.submit(SetTuning("R.winding", 0.25))
    for one in (page, second):
        one.wait_for_function("[...document.querySelectorAll('input')].some(input => input.value === '0.25')")
    other.close()
    assert engine.commands == [SetTuning("R.winding", 0.25)]


def test_a_lost_filter_says_since_when_and_is_reset_by_hand(browser):
    made, plain = stubborn("kf"), shown_twin()
    made.config = plain.config
    source = Scripted()
    engine = Engine(made, lambda report: source)
    view = ViserView(engine, secret="s3cret")
    engine.start()
    view.start()
    context = browser.new_context(viewport={"width": 900, "height": 1000}, extra_http_headers={HEADER: "s3cret"})
    try:
        t, y = asset(RESET_AT + 10)
        source.put(readings(t[:RESET_AT], y[:RESET_AT]))
        page = context.new_page()
        page.set_default_timeout(60_000)
        page.goto(f"http://127.0.0.1:{view.port}/")
        # The 26th refused reading is more than half of the last fifty.
        page.get_by_text(f"diverged since {JUMP + 25}.0 s").wait_for()
        page.get_by_role("button", name="Reset").click()
        wait_for(lambda: engine.status().health == TRACKING)
        page.get_by_text("tracking", exact=False).first.wait_for()
        source.put(readings(t[RESET_AT:], y[RESET_AT:]))
        wait_for(lambda: engine.status().counts["used"] >= JUMP + 10)
        assert engine.status().health == TRACKING
        assert page.get_by_text("starts again from the prior").count() <= 1
    finally:
        context.close()
        view.stop()
        engine.stop()
