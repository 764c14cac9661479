"""Viser's own window in headless Chromium: what is drawn, and what a hand on the controls makes the engine do."""

import numpy as np
import pytest

from app.live.commands import SetEstimator, SetTuning
from app.views.viser.guarded_server import HEADER
from app.views.viser.scene import place
from app.views.viser.view import ViserView
from estimators.log import READING, TRUTH, Events
from estimators.models import MODELS
from tests.app.scripted import events, viewed, wait_for

pytestmark = pytest.mark.browser

WINDING = MODELS["motor_winding"]
CHARTS = "Object.values(window.__viserTestpoints?.uplots ?? {}).map(item => item.chart)"


@pytest.fixture
def engine():
    engine = viewed(WINDING)
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
    # The chart is drawn: uPlot found a range and holds the readings.
    page.wait_for_function(f"{CHARTS}.length === 1 && {CHARTS}[0].data[0].length >= 30")
    # It has the data before it has a size.
    page.wait_for_function(f"{CHARTS}.every(chart => chart.ctx.canvas.width > 0)")
    yield page
    context.close()
    assert errors == []


def sliders(page):
    """What the sliders of the panel show now, in powers of ten from the configured variance."""
    shown = page.get_by_role("slider").evaluate_all("all => all.map(one => one.getAttribute('aria-valuenow'))")
    return [float(text) for text in shown]


def test_the_chart_is_drawn_with_band_and_line(page):
    low, high = page.evaluate(f"(() => {{ const y = {CHARTS}[0].scales.y; return [y.min, y.max]; }})()")
    assert low <= 0.0 and 1.3 < high < 20.0
    colours = page.evaluate(
        f"""(() => {{
            const canvas = {CHARTS}[0].ctx.canvas;
            const data = {CHARTS}[0].ctx.getImageData(0, 0, canvas.width, canvas.height).data;
            const count = {{estimate: 0, band: 0}};
            for (let i = 0; i < data.length; i += 4) {{
                const [r, g, b, a] = data.slice(i, i + 4);
                if (a > 200 && b > 180 && r < 60) count.estimate++;
                if (a > 30 && a < 90 && Math.abs(r - b) < 60) count.band++;
            }}
            return count;
        }})()"""
    )
    assert colours["estimate"] > 100 and colours["band"] > 1000


def test_a_chosen_axis_is_drawn_and_the_other_takes_its_place(page, view):
    before = view.stage.scene
    page.get_by_role("combobox", name="x", exact=True).click()
    page.get_by_role("option", name="rate", exact=True).click()
    wait_for(lambda: view.stage.scene is not before)
    assert [axis.state for axis in view.stage.scene.axes] == [1, 0]
    wait_for(lambda: view.panel.choices["y"].value == "temperature")


def test_each_pane_gets_a_camera_that_fills_it(page, view):
    """A pane that grows higher moves its camera; one whose user turns it is left alone."""
    (client,) = view.server.get_clients().values()
    wait_for(lambda: np.allclose(client.camera.position, place(view.stage.scene.outlook, client.camera.aspect)[0]))
    wide = client.camera.position.copy()
    page.set_viewport_size({"width": 600, "height": 1000})
    wait_for(lambda: np.linalg.norm(client.camera.position) > 1.3 * np.linalg.norm(wide))
    page.mouse.move(100, 500)
    page.mouse.wheel(0, -400)
    fitted = place(view.stage.scene.outlook, client.camera.aspect)[0]
    wait_for(lambda: np.linalg.norm(client.camera.position) < 0.98 * np.linalg.norm(fitted))


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
    wait_for(lambda: abs(sliders(page)[0] - np.log10(engine.status().tuning.get("Q.temperature") / 0.01)) < 0.01)
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
    second.wait_for_function(f"{CHARTS}.length === 1 && {CHARTS}[0].data[0].length >= 30")
    engine.submit(SetTuning("R.winding", 0.25))
    for one in (page, second):
        one.get_by_text("revision 1").wait_for()
    decades = np.log10(0.25 / 4.0)
    at = [key for key in view.panel.controls.handles if key[:2] in ("Q.", "R.")].index("R.winding")
    for one in (page, second):
        wait_for(lambda one=one: abs(sliders(one)[at] - decades) < 0.01)
    other.close()
    assert engine.commands == [SetTuning("R.winding", 0.25)]
