"""The scene on the page in headless Chromium: chosen, large, and each view in a window of its own."""

import numpy as np
import pytest

from app.web.http import PAGE
from tests.app.web.page.browsed import pixels, running, until
from tests.waiting import wait_for

pytestmark = pytest.mark.browser


@pytest.fixture
def session():
    with running("motor_winding", 4.0) as session:
        yield session


@pytest.fixture
def page(visit, session):
    return visit(session.url, scene=True)


def asked(session):
    """The queries of the browsers' sockets, as Viser's server knows them."""
    from app.scene.guarded_server import addresses

    return sorted(addresses(session.running.view.server))


def scene_is_drawn(page):
    """Wait for it, and return its frame."""
    frame = page.locator("#stage").element_handle().content_frame()
    frame.wait_for_function("document.body && getComputedStyle(document.body).opacity === '1'")
    return frame


AFTER = "getComputedStyle(document.getElementById('scene'), '::after').content"


def test_a_scene_whose_document_comes_late_is_announced(page):
    held = []
    page.route("**/viser/?*", lambda route: held.append(route))
    page.reload()
    wait_for(lambda: held or page.evaluate("1") is None)
    assert "Loading the scene" in page.evaluate(AFTER)
    held[0].continue_()
    until(page, f"{AFTER} === 'none'")


def test_the_scene_is_chosen_enlarged_and_opened_alone(visit, session):
    assert asked(session) == [] and session.running.view.history.n == 0
    page = visit(session.url, scene=True)
    wait_for(lambda: asked(session) == ["theme=light"])
    wait_for(lambda: session.running.view.history.n > 0)

    select = page.get_by_label("Scene: Show")
    select.select_option("belief")
    wait_for(lambda: session.running.view.renderer.choices.values()["show"] == "belief")
    page.get_by_label("Scene: x", exact=True).select_option("rate")
    wait_for(lambda: session.running.view.renderer.choices.values()["y"] == "temperature")
    until(page, "document.querySelector('[aria-label=\"Scene: y\"]').value === 'temperature'")

    # Once more S: the scene is larger than the charts, and stays so over a reload.
    assert page.evaluate("document.getElementById('stage').clientWidth") < 400
    page.locator("body").press("s")
    until(page, "document.getElementById('stage').clientWidth > document.getElementById('charts').clientWidth")
    page.reload()
    until(page, "document.getElementById('stage').clientWidth > document.getElementById('charts').clientWidth")

    # Hidden, nothing is sent for it.
    page.get_by_role("tab", name="Runs").click()
    wait_for(lambda: asked(session) == [])
    page.get_by_role("tab", name="Scene").click()

    with page.context.expect_page() as opened:
        page.get_by_label("Scene in a window of its own").click()
    alone = opened.value
    wait_for(lambda: asked(session) == ["theme=light", "theme=light"])
    until(alone, "getComputedStyle(document.body).opacity === '1'")
    alone.wait_for_selector("canvas")
    # Viser's own panel is hidden; a link leads to the page.
    assert not alone.locator(".mantine-Paper-root:visible").count()
    alone.get_by_role("link", name="Charts and controls").click()
    alone.wait_for_selector("#charts .chart canvas")


def test_in_the_dark_the_scene_has_light_labels_on_dark(visit, session):
    """Viser draws black on white: boxes of some thousand pixels. Letters alone are a few hundred."""
    page = visit(session.url, scheme="dark", scene=True)
    wait_for(lambda: session.running.view.history.n > 0)

    scene_is_drawn(page)

    def light_labels():
        """By the pixels of the lower half, with a scale's numbers and the temperature in words: as grey, as light."""
        found = pixels(page, "#stage", 0.5)
        grey, least = np.ptp(found, axis=2) < 40, found.min(axis=2)
        return np.mean(grey & (least > 110)) > 2e-4 and np.mean(grey & (least > 190)) < 2e-3

    wait_for(light_labels)


def opacity(page):
    return page.evaluate("getComputedStyle(document.body).opacity")


def draw(page, times):
    """So many drawings of nothing, in one picture."""
    page.evaluate(
        "times => { const gl = document.createElement('canvas').getContext('webgl2');"
        " for (let k = 0; k < times; k++) gl.drawArrays(gl.POINTS, 0, 0); }",
        times,
    )


def counted(page):
    return "[native code]" not in page.evaluate("WebGL2RenderingContext.prototype.drawArrays.toString()")


@pytest.mark.parametrize("scene", ["drawn", "empty", "late", "never drawn"])
def test_the_scene_is_hidden_until_it_is_drawn(browser, scene):
    """By a test's own clock: five drawings show it once no more are added, any after 4 s, or 20 s alone."""
    page = browser.new_context().new_page()
    page.clock.install(time=0)
    page.clock.pause_at(1000)
    page.set_content("<p>axes</p>")
    page.add_script_tag(path=PAGE / "viser_frame.js")
    assert opacity(page) == "0" and counted(page)
    assert "Loading the scene" in page.evaluate("getComputedStyle(document.documentElement, '::after').content")
    if scene in ("drawn", "empty"):
        draw(page, 4)
    page.clock.run_for(1000)
    assert opacity(page) == "0"
    wait = {"drawn": 400, "empty": 2900, "late": 4000, "never drawn": 18_900}[scene]
    if scene == "drawn":
        draw(page, 5)
        page.clock.run_for(400)
        draw(page, 6)
    page.clock.run_for(wait)
    assert opacity(page) == "0"
    if scene == "late":
        draw(page, 1)
        page.clock.run_for(400)
        assert opacity(page) == "0"
    page.clock.run_for(200)
    assert opacity(page) == "1" and not counted(page)


def test_the_scene_is_seen_on_the_page(page, session):
    wait_for(lambda: asked(session) != [])
    frame = scene_is_drawn(page)
    frame.wait_for_selector("canvas")
    assert not counted(frame)
