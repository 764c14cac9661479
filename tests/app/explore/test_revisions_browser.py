"""Between two revisions a real browser shows the viewer's last picture, until the next one has rows and colours."""

import base64
import io

import numpy as np
import pytest

from app.engine import commands
from app.engine.engine import Engine
from app.web.server import PageServer
from tests.app.scripted import Scripted, readings, twin
from tests.app.served import SECRET
from tests.app.web.page.browsed import until
from tests.waiting import wait_for

pytestmark = pytest.mark.browser

NOTE = """() => {
    window.covered = [];
    const cover = document.getElementById("before");
    const note = () => {
        window.covered.push([!cover.hidden, window.nisus.viewer.announced]);
        if (!cover.hidden) window.picture = cover.toDataURL();
    };
    new MutationObserver(note).observe(cover, { attributes: true, attributeFilter: ["hidden"] });
}"""

# The canvas is whole pixels, wherever on the page it begins.
PIXELS = """() => {
    const canvas = document.getElementById("rerun"), at = canvas.getBoundingClientRect();
    return { x: Math.round(at.x), y: Math.round(at.y), width: canvas.width, height: canvas.height };
}"""


def colours(png):
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def at_rest(page):
    """What a person sees of the viewer, once two looks at it are alike."""
    box, looks = page.evaluate(PIXELS), []

    def alike():
        looks.append(page.screenshot(clip=box))
        return len(looks) > 1 and looks[-1] == looks[-2]

    wait_for(alike)
    return colours(looks[-1])


def test_the_viewer_is_covered_until_it_has_drawn_the_next(browser):
    source = Scripted()
    engine = Engine(twin(), lambda report: source)
    server = PageServer(engine, port=0, viser_port=None, secret=SECRET)
    engine.start()
    server.start()
    page = browser.new_context(viewport={"width": 800, "height": 600}).new_page()
    try:
        t = np.arange(1.0, 101.0)
        source.put(readings(t, 40 + np.sin(t)))
        page.goto(server.url)
        page.get_by_role("tab", name="Explore").click()
        until(page, "window.nisus?.explored > 0")
        page.evaluate(NOTE)
        before = at_rest(page)
        engine.submit(commands.SetTuning("Q.temperature", 0.5))
        wait_for(lambda: engine.status().revision == 1)
        until(page, "window.nisus.panes.explore.revisions.drawn === 1 && !window.nisus.viewer.announced")
        until(page, "window.covered.length > 1")
        covered = page.evaluate("window.covered")
        assert [shown for shown, *_ in covered] == [True, False]
        assert not covered[-1][1]
        held = colours(base64.b64decode(page.evaluate("window.picture").partition(",")[2]))
        assert held.shape == before.shape and before.std() > 5
        assert np.mean(np.abs(held - before).max(axis=-1) > 32) < 0.01
    finally:
        engine.stop()
        server.stop()
