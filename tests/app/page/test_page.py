"""The whole program in headless Chromium: what a person does on the page, what the engine and the files made of it."""

import io

import numpy as np
import pytest

from app.cli.review import open_review
from app.cli.run import live_source
from app.recording.reader import read_recording
from app.session import Page, Session
from app.twin.twin import load_twin
from tests.app.scripted import pull_all, wait_for

pytestmark = pytest.mark.browser

FLAGS = (
    "--headless=new --no-sandbox --disable-gpu --enable-unsafe-swiftshader --disable-background-networking "
    "--disable-component-update --disable-sync --no-first-run --disable-quic"
).split()
PATIENCE = 120.0
"""Seconds for a step on a busy machine without a graphics card; a test that works takes a fraction."""


@pytest.fixture(scope="module")
def browser(chromium):
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        yield started
        started.close()


@pytest.fixture
def served():
    sessions = []

    def serve(session):
        sessions.append(session)
        session.start()
        return session

    yield serve
    for session in sessions:
        session.stop()


def until(page, expression):
    """Ask from outside: the page's own policy forbids the evaluation that waiting inside it would need."""
    wait_for(lambda: page.evaluate(expression), PATIENCE)


def open_page(browser, session, asked):
    context = browser.new_context(viewport={"width": 1500, "height": 950})
    page = context.new_page()
    page.set_default_timeout(PATIENCE * 1000)
    page.on("request", lambda request: asked.append(request.url))
    page.goto(session.url)
    until(page, "window.nisus?.drawn > 0")
    page.frame_locator("#viser").get_by_text("Process noise Q").wait_for()
    return page


def pixels(page, box):
    """What is drawn in a part of the page, as an array of colours (rows, columns, 3)."""
    from PIL import Image

    picture = page.screenshot(clip=box, timeout=PATIENCE * 1000)
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)


def drawn(page, selector):
    """How much of an element is estimate (blue), reading (orange) and truth (green)."""
    colours = pixels(page, page.locator(selector).bounding_box())
    red, green, blue = colours[..., 0], colours[..., 1], colours[..., 2]
    return {
        "estimate": int(np.sum((blue > 180) & (red < 100) & (green < 150))),
        "reading": int(np.sum((red > 210) & (green > 120) & (green < 190) & (blue < 90))),
        "truth": int(np.sum((green > 130) & (red < 100) & (blue < 130))),
    }


def drag_right(page, thumb, reached):
    """Drag a slider until the engine has it; while a swapped filter's options unfold, the panel moves: try again."""
    for _ in range(6):
        box = thumb.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        for step in range(1, 16):
            page.mouse.move(x + 3 * step, y)
        page.mouse.up()
        try:
            wait_for(reached, PATIENCE / 6)
        except AssertionError:
            continue
        return
    pytest.fail("the engine never had the slider's value")


def test_a_session_on_the_page(browser, served, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    twin = load_twin("motor_winding")
    session = served(Session(twin, live_source(twin, 8.0), page=Page(0, open_browser=False)))
    engine = session.engine
    asked: list[str] = []
    page = open_page(browser, session, asked)
    panel = page.frame_locator("#viser")

    # Both views draw, not only exist.
    wait_for(lambda: drawn(page, "#rerun")["estimate"] > 200, PATIENCE)
    seen = drawn(page, "#rerun")
    assert seen["reading"] > 30 and seen["truth"] > 30
    wait_for(lambda: drawn(page, "#viser")["estimate"] > 200, PATIENCE)

    # Record from the panel.
    panel.get_by_role("tab", name="Play").click()
    panel.get_by_role("button", name="Record", exact=True).click()
    wait_for(lambda: engine.status().recording is not None, PATIENCE)
    path = tmp_path / engine.status().recording
    assert path.name.startswith("motor_winding") and path.suffix == ".rrd"

    # Swap the filter. The right pane says that it is behind, from the word of a new revision until that is drawn.
    page.evaluate(
        """() => {
            window.said = [];
            const behind = document.getElementById("behind");
            const note = () => window.said.push([behind.hidden, behind.textContent]);
            new MutationObserver(note).observe(behind, { attributes: true, childList: true });
        }"""
    )
    panel.get_by_role("tab", name="Tune").click()
    panel.get_by_role("combobox", name="Estimator").click()
    panel.get_by_role("option", name="Unscented Kalman filter", exact=True).click()
    wait_for(lambda: engine.status().estimator == "ukf" and not engine.status().refolding, PATIENCE)
    assert engine.status().revision == 1
    until(page, "window.said.some(([hidden]) => !hidden) && document.getElementById('behind').hidden")
    said = page.evaluate("window.said")
    assert [False, "revision 0 still; drawing 1 …"] in said and said[-1] == [True, ""]
    assert page.evaluate("window.nisus.revision") == 1

    # Drag Q: larger process noise must make a wider band on every row of the history.
    before = pull_all(engine)
    drag_right(page, panel.get_by_role("slider").first, lambda: engine.status().tuning.get("Q.temperature") > 0.05)
    wait_for(lambda: (engine.status().tuning.get("Q.temperature") > 0.05) and not engine.status().refolding, PATIENCE)
    after = pull_all(engine)
    assert after.revision > before.revision
    rows = len(before.events)
    assert np.all(after.track.std[10:rows, 0] > before.track.std[10:rows, 0])
    until(page, f"window.nisus.revision >= {after.revision}")
    until(page, "window.nisus.status.estimator === 'ukf'")
    assert page.locator("#estimator").inner_text() == "UKF"

    # Stop the recording once the source has ended, so that it holds everything.
    wait_for(lambda: engine.status().finished, PATIENCE)
    final = pull_all(engine)
    panel.get_by_role("tab", name="Play").click()
    panel.get_by_role("button", name="Stop").click()
    wait_for(lambda: engine.status().recording is None and session.recorder.finished, PATIENCE)
    recorded = read_recording(path)
    np.testing.assert_array_equal(recorded.events.value, final.events.value)

    # Nothing was asked of anybody else. What the viewer tries, the page's policy stops before it leaves.
    own = f"http://127.0.0.1:{session.server.port}/"
    strangers = [url for url in asked if not url.startswith((own, "blob:", "data:", "https://tel.rerun.io/"))]
    assert strangers == []
    page.context.close()

    # Review: the same program over the recorded readings, to the same bits, and it draws.
    review, _ = open_review(path, Page(0, open_browser=False))
    served(review)
    wait_for(lambda: review.engine.status().finished, PATIENCE)
    np.testing.assert_array_equal(pull_all(review.engine).track.mean, final.track.mean)
    page = open_page(browser, review, asked)
    wait_for(lambda: drawn(page, "#rerun")["estimate"] > 200, PATIENCE)
    assert page.locator("#estimator").inner_text() == "UKF"
    panel = page.frame_locator("#viser")
    panel.get_by_role("combobox", name="Estimator").click()
    panel.get_by_role("option", name="Kalman filter", exact=True).click()
    wait_for(lambda: review.engine.status().estimator == "kf" and not review.engine.status().refolding, PATIENCE)
    until(page, "window.nisus.revision >= 1")
    page.context.close()
