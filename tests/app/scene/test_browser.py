"""Viser's own page in headless Chromium: the camera."""

import numpy as np
import pytest

from app.scene.guarded_server import HEADER
from app.scene.scene import place
from app.scene.view import ViserView
from tests.app.scene.test_view import WINDING, history
from tests.app.scripted import viewed
from tests.waiting import wait_for

pytestmark = pytest.mark.browser


@pytest.fixture
def engine():
    engine = viewed(WINDING)
    engine.put(history(seed=3))
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
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"http://127.0.0.1:{view.port}/")
    page.wait_for_selector("canvas")
    wait_for(lambda: len(view.server.get_clients()) == 1)
    yield page
    assert errors == []


def test_each_pane_gets_a_camera_that_fills_it(page, view):
    """A pane that grows higher moves its camera; one whose user turns it is left alone."""
    (client,) = view.server.get_clients().values()
    wait_for(lambda: np.allclose(client.camera.position, place(view.renderer.scene.outlook, client.camera.aspect)[0]))
    wide = client.camera.position.copy()
    page.set_viewport_size({"width": 600, "height": 1000})
    wait_for(lambda: np.linalg.norm(client.camera.position) > 1.3 * np.linalg.norm(wide))
    page.mouse.move(100, 500)
    page.mouse.wheel(0, -400)
    fitted = place(view.renderer.scene.outlook, client.camera.aspect)[0]
    wait_for(lambda: np.linalg.norm(client.camera.position) < 0.98 * np.linalg.norm(fitted))
