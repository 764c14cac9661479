"""The whole program in headless Chromium: actions on the page, and their effect on engine and files."""

import numpy as np
import pytest

from app.cli.run import open_review
from app.record.reader import read_recording
from app.web.session import Page
from tests.app.scripted import pull_all
from tests.app.web.page.browsed import drawn, running, settled, until
from tests.waiting import TEST_LIMIT_S, wait_for

pytestmark = pytest.mark.browser


@pytest.fixture
def served(request):
    """served(session): a session that runs, or a twin's name and speed, until the end of the test."""

    def serve(name, speed, **overrides):
        made = running(name, speed, **overrides)
        request.addfinalizer(lambda: made.__exit__(None, None, None))
        return made.__enter__()

    return serve


def test_a_session_on_the_page(visit, served, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    # Its source has not ended when it is paused, however slow the machine.
    session = served("motor_winding", 2.0, **{"source.duration": f"{2.0 * TEST_LIMIT_S:.0f}"})
    engine, twin = session.engine, session.engine.twin
    page = visit(session.url, scene=True)

    # The charts draw, not only exist; and so does the scene.
    wait_for(lambda: drawn(page, "#charts")["estimate"] > 200)
    wait_for(lambda: drawn(page, "#charts")["reading"] > 30)
    page.frame_locator("#stage").locator("canvas").first.wait_for()
    # Hidden it is drawn no more, which takes a processor.
    page.get_by_role("tab", name="Runs").click()

    # Record from the strip.
    page.get_by_role("button", name="Record").click()
    wait_for(lambda: engine.status().recording is not None)
    path = tmp_path / engine.status().recording
    assert path.name.startswith("motor_winding") and path.suffix == ".rrd"

    # Swap the filter.
    page.get_by_label("Estimator", exact=True).select_option("ukf")
    wait_for(lambda: engine.status().estimator == "ukf" and engine.status().revision == 1)
    settled(engine)
    until(page, "window.nisus.revision === 1")

    # Turn Q by its slider's keys: larger process noise must make a wider band on every row of the history.
    before = pull_all(engine)
    slider = page.locator('[data-key="Q.temperature"] input[type=range]')
    slider.focus()
    for _ in range(5):
        page.keyboard.press("PageUp")
    wait_for(lambda: engine.status().tuning.get("Q.temperature") > 0.05)
    settled(engine)
    after = pull_all(engine)
    assert after.revision > before.revision
    rows = len(before.events)
    assert np.all(after.track.std[10:rows, 0] > before.track.std[10:rows, 0])
    until(page, f"window.nisus.revision >= {after.revision}")

    # A number that is none is said at once, under its field; one that is, is taken; and it is undone and done again.
    field = page.get_by_label("rate, value")
    field.fill("much")
    field.press("Enter")
    page.get_by_text("it must be a number").wait_for()
    field.fill("0,002")
    field.press("Enter")
    wait_for(lambda: engine.status().tuning.get("Q.rate") == 0.002)
    page.locator("#undo").click()
    wait_for(lambda: engine.status().tuning.get("Q.rate") == twin.tuning.get("Q.rate"))
    page.locator("#redo").click()
    wait_for(lambda: engine.status().tuning.get("Q.rate") == 0.002)

    # Hold the sensor out, and use it again.
    box = page.locator(".sensor input").first
    box.uncheck()
    wait_for(lambda: not engine.status().tuning.used[0])
    box.check()
    wait_for(lambda: engine.status().tuning.used[0])
    page.get_by_label("Gate", exact=True).select_option("0.9999")
    wait_for(lambda: engine.status().tuning.gate == 0.9999)
    settled(engine)

    # Time: pause, go on, look at a part, follow again.
    page.get_by_label("Pause or continue").click()
    wait_for(lambda: engine.status().paused)
    until(page, "window.nisus.link.status.paused")  # as its user sees, before it is pressed again
    page.keyboard.press("Escape")
    chart = page.locator(".u-over").first.bounding_box()
    page.mouse.move(chart["x"] + 100, chart["y"] + 20)
    page.mouse.down()
    page.mouse.move(chart["x"] + 300, chart["y"] + 20, steps=5)
    page.mouse.up()
    until(page, "!window.nisus.view.following")
    since, until_ = page.evaluate("[window.nisus.view.since, window.nisus.view.until]")
    assert 0 < until_ - since < twin.config.view.window / 2
    page.locator("#follow").click()
    until(page, "window.nisus.view.following")
    page.get_by_label("Speed").select_option("inf")
    page.get_by_label("Pause or continue").click()
    wait_for(lambda: engine.status().finished)

    # Stop the recording once the source has ended, so that it holds everything.
    settled(engine)
    final = pull_all(engine)
    page.get_by_role("button", name="Record").click()
    wait_for(lambda: engine.status().recording is None and session.recorder.finished)
    recorded = read_recording(path)
    np.testing.assert_array_equal(recorded.events.value, final.events.value)
    page.get_by_role("link", name=path.name).wait_for()

    # Review: the same program over the recorded readings, to the same bits, and it draws.
    review, _ = open_review(path, Page(0, open_browser=False))
    review.start()
    request.addfinalizer(review.stop)
    wait_for(lambda: review.engine.status().finished)
    np.testing.assert_array_equal(pull_all(review.engine).track.mean, final.track.mean)
    page = visit(review.url)
    wait_for(lambda: drawn(page, "#charts")["estimate"] > 200)
    assert page.get_by_label("Estimator", exact=True).input_value() == "ukf"
    page.get_by_label("Estimator", exact=True).select_option("kf")
    wait_for(lambda: review.engine.status().estimator == "kf")
    settled(review.engine)
    until(page, "window.nisus.revision >= 1")


def test_two_browsers_see_the_same_fault(visit, served):
    """Put in from one page, said on both with its cause; a reload keeps it; taken away, it is over on both."""
    session = served("motor_can", 1.0)
    first, second = visit(session.url), visit(session.url)
    wait_for(lambda: session.engine.status().counts.get("readings", 0) > 150)
    first.get_by_text("Faults on demand").click()
    first.get_by_label("Fault", exact=True).select_option("bias")
    first.get_by_label("Target").select_option("yoke")
    # A smaller one passes the gate now and then, moves the estimate, and 15 to 30 s later the tooth is off as well.
    first.get_by_label("size").fill("6")
    first.locator("#inject").click()
    for page in (first, second):
        wait_for(lambda page=page: "yoke" in page.locator("#cause").inner_text())
        until(page, "document.getElementById('health').dataset.health === 'degraded'")
    second.reload()
    wait_for(lambda: "yoke" in second.locator("#cause").inner_text())
    second.get_by_role("tab", name="Episodes").click()
    assert "yoke" in second.locator(".episode[data-open=true]").first.inner_text()
    first.get_by_role("button", name="stop", exact=True).click()
    wait_for(lambda: not session.engine.status().faults)
