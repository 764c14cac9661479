"""The curve around a knob, in headless Chromium, on a session of its own."""

import io

import numpy as np
import pytest

from app.cli.run import live_source
from app.session import Page, Session
from app.twin.twin import load_twin
from estimators.fold import fold
from estimators.log import Log
from estimators.track import GATED, USED
from tests.app.scripted import pull_all, wait_for

pytestmark = pytest.mark.browser

FLAGS = "--headless=new --no-sandbox --disable-gpu --enable-unsafe-swiftshader --no-first-run".split()
PATIENCE = 120.0
"""Seconds for a step on a busy machine; a test that works takes a fraction."""

PINNED = (176, 51, 143)
"""The colour of the first place, in the light theme: app/page/style.css, --pin-0."""


@pytest.fixture(scope="module")
def session():
    twin = load_twin("motor_winding")
    running = Session(twin, live_source(twin, float("inf")), page=Page(0, open_browser=False))
    running.start()
    wait_for(lambda: running.engine.status().finished, PATIENCE)
    yield running
    running.stop()


@pytest.fixture
def page(chromium, session):
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_context(viewport={"width": 1440, "height": 900}, color_scheme="light").new_page()
        page.set_default_timeout(PATIENCE * 1000)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(session.url)
        wait_for(lambda: page.evaluate("window.nisus?.drawn > 0"), PATIENCE)
        yield page
        assert errors == []
        browser.close()


def coloured(page, selector):
    """Pixels of the first pin's colour in an element."""
    from PIL import Image

    picture = page.screenshot(clip=page.locator(selector).first.bounding_box())
    pixels = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)
    return int(np.sum(np.abs(pixels - PINNED).sum(axis=2) < 60))


def settled(engine, revision):
    wait_for(lambda: engine.revisions.runs[-1].number >= revision and not engine.status().refolding, PATIENCE)


def likelihood(track):
    used = track.verdict == USED
    assert not np.any(track.verdict == GATED)
    return track.log_likelihood[used].sum()


def test_the_curve_around_a_knob_shows_the_likeliest_value(page, session):
    engine = session.engine
    key = next(item.key for item in engine.tuning.items() if item.key.startswith("R."))
    label = page.locator(f'[data-key="{key}"] label')
    label.focus()
    label.press("Enter")
    curve = page.locator(f'[data-key="{key}"] .around')
    wait_for(lambda: curve.get_attribute("data-done") == "true", PATIENCE)
    assert curve.locator("circle").count() == 7

    status, model, log = engine.status(), engine.model, Log.of(engine.model)
    log.extend(pull_all(engine).events)
    value = status.tuning.get(key)
    values = [value * factor for factor in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)]
    ungated = [status.tuning.set(key, item).set("gate", None) for item in values]
    best = values[int(np.argmax([likelihood(fold(status.estimator, model, tuning, log)) for tuning in ungated]))]
    said = curve.locator("output").inner_text()
    assert float(said.split("likeliest at ")[1].split(",")[0]) == pytest.approx(best, rel=0.01)

    take = curve.locator(".takes button:not([hidden])").last
    wanted = float(take.inner_text().split()[-1])
    take.evaluate("button => button.click()")
    wait_for(lambda: engine.status().tuning.get(key) == pytest.approx(wanted, rel=0.01), PATIENCE)
