"""One time: Rerun and the page show the same moment; a recording opens folded, and is replayed from any moment."""

import numpy as np
import pytest

from config.loader import TWINS
from estimators.track import HEALTH_NAMES
from tests.app.scripted import pull_all
from tests.app.web.page.browsed import running, until
from tests.waiting import wait_for

pytestmark = pytest.mark.browser

CURSOR = """() => {
    const viewer = window.nisus.viewer, { active, recordings } = viewer.state();
    const { time, play } = recordings.find(({ id }) => id === active);
    return [Number(time) / 1e9, Number(play)];
}"""

SCRUB = """async ([seconds, play]) => {
    const { setTimeCursor } = await import("/page/rerun.js");
    const { viewer } = window.nisus;
    await viewer.control(setTimeCursor(viewer.id, "time", BigInt(Math.round(seconds * 1e9)), BigInt(play)));
}"""

PAUSED, FOLLOWING = 1, 3


def cursor_is(page, seconds, play):
    def there():
        time, state = page.evaluate(CURSOR)
        return state == play and time == pytest.approx(seconds, abs=1e-6)

    wait_for(there)


def test_page_and_rerun_show_one_time(page, session):
    end = float(pull_all(session.engine).events.t[-1]) * 1e-9

    # Held before Rerun is shown for the first time: it comes up where the page is.
    page.evaluate("window.nisus.view.show(20, 50)")
    page.get_by_role("tab", name="Explore").click()
    until(page, "window.nisus.explored > 0")
    cursor_is(page, 50.0, PAUSED)

    # The page's own track, clicked; then back to the newest row.
    box = page.locator("#timeline").bounding_box()
    page.mouse.click(box["x"] + 0.75 * box["width"], box["y"] + 20)
    cursor_is(page, 0.75 * end, PAUSED)
    page.locator("body").press("f")
    cursor_is(page, end, FOLLOWING)

    # Scrubbed in Rerun: the page is held there, and says so; what follows there follows here.
    page.evaluate(SCRUB, [30.5, PAUSED])
    until(page, "Math.abs(window.nisus.view.at - 30.5) < 1e-6 && !window.nisus.view.following")
    assert page.locator("#at").inner_text() == "at 0:30.5"
    page.evaluate(SCRUB, [0, FOLLOWING])
    until(page, "window.nisus.view.following")
    assert page.locator("#at").inner_text() == ""

    # Hidden, it is neither asked nor moved.
    page.evaluate(SCRUB, [12.0, PAUSED])
    until(page, "Math.abs(window.nisus.view.at - 12) < 1e-6")
    page.get_by_role("tab", name="Charts").click()
    page.evaluate("window.nisus.view.goTo(33, window.nisus.charts.range)")
    assert page.evaluate("window.nisus.panes.explore.time.timer") is None
    cursor_is(page, 12.0, PAUSED)
    page.get_by_role("tab", name="Explore").click()
    cursor_is(page, 33.0, PAUSED)


def test_rerun_in_a_window_of_its_own_shares_the_time_of_the_page(visit, session):
    # Without a graphics processor a picture of Rerun takes as long as it is large.
    page = visit(session.url, size=(800, 500))
    page.evaluate("window.nisus.view.show(20, 50)")
    alone = visit(session.url.partition("?")[0] + "explore", beside=page, ready="window.nisus?.explored > 0")
    assert alone.locator("#notice").is_hidden()
    assert alone.locator("#rerun").evaluate("(node) => node.clientHeight") > 400
    assert alone.locator("#shared").inner_text() == "one time with the page"
    cursor_is(alone, 50.0, PAUSED)
    # What is gone to on the page moves it, and what is scrubbed in it moves the page.
    page.evaluate("window.nisus.view.goTo(33, window.nisus.charts.range)")
    cursor_is(alone, 33.0, PAUSED)
    alone.evaluate(SCRUB, [30.5, PAUSED])
    until(page, "Math.abs(window.nisus.view.at - 30.5) < 1e-6 && !window.nisus.view.following")
    alone.evaluate(SCRUB, [0, FOLLOWING])
    until(page, "window.nisus.view.following")
    # Without the page it says that it is alone, and is its own master.
    page.goto("about:blank")
    until(alone, "document.getElementById('shared').textContent.startsWith('a time of its own')")
    alone.evaluate(SCRUB, [12.0, PAUSED])
    until(alone, "Math.abs(window.nisus.view.at - 12) < 1e-6")


def test_a_recording_opens_folded_and_is_replayed_from_the_cursor(visit):
    with running("motor_can", None, log=TWINS.parent / "logs" / "motor_can.blf", **{"view.cursor": "60"}) as session:
        engine = session.engine
        page = visit(session.url)
        until(page, "window.nisus.view.at === 60")
        track = pull_all(engine)
        start, end = (float(time - track.events.t[0]) * 1e-9 for time in track.events.t[[0, -1]])
        assert end > 170.0
        until(page, f"Math.abs(window.nisus.charts.range[1] - {end}) < 1e-3")
        since, last = page.evaluate("window.nisus.charts.range")
        assert since == start
        assert page.evaluate("document.getElementById('window').value") == "all"
        assert not [item for item in engine.notices.since(0) if item.level == "warn"]
        # A page rounds the times of a calendar to 256 ns: just before its end is still the last row.
        page.evaluate("(end) => window.nisus.view.show(0, end, end - 2e-7)", last)
        until(page, "window.nisus.link.status.moment?.t === window.nisus.link.status.t")
        page.evaluate("(end) => window.nisus.view.show(0, end, 60)", last)
        until(page, "window.nisus.link.status.moment?.t < window.nisus.link.status.t")

        page.locator("#pause").click()
        wait_for(lambda: engine.status().speed == 1.0 and not engine.status().finished)
        until(page, "window.nisus.view.following && window.nisus.charts.newest < 100")
        # The replay shows a window, and so does a part that is zoomed: the list of widths says so.
        until(page, "document.getElementById('window').value === String(window.nisus.model.window)")
        page.evaluate("window.nisus.view.show(10, 27)")
        until(page, "document.getElementById('window').selectedOptions[0].text === '17 s'")
        page.evaluate("window.nisus.view.follow()")
        replayed = pull_all(engine)
        n = len(replayed.track.mean)
        assert float(replayed.events.t[n - 1] - track.events.t[0]) * 1e-9 == pytest.approx(60.0, abs=30.0)
        assert np.array_equal(replayed.track.mean, track.track.mean[:n])

        page.locator("#speed").select_option("inf")
        wait_for(lambda: engine.status().finished)
        assert np.array_equal(pull_all(engine).track.mean, track.track.mean)


LONG = """model: motor_winding
estimator: kf
prior: {temperature: {mean: 40, std: 5}, rate: {mean: 0, std: 0.001}}
noise: {temperature: {variance: 0.001}, rate: {variance: 1e-12}}
sensors: {winding: {std: 2}}
time: {degraded_after: 20000, stale_after: 80000, tick: 3600}
source: {type: table, files: month.csv, time: {column: t, unit: h}, sensors: {winding: {columns: T}}}
view: {window: 720000}
"""


def test_a_month_is_replayed_in_minutes_and_its_axis_counts_days(tmp_path, visit):
    rng = np.random.default_rng(0)
    rows = np.column_stack([np.arange(30 * 24), 40 + np.cumsum(rng.normal(0, 1, 30 * 24))])
    np.savetxt(tmp_path / "month.csv", rows, delimiter=",", header="t,T", comments="")
    (tmp_path / "month.yaml").write_text(LONG)
    with running(str(tmp_path / "month.yaml"), None) as session:
        page = visit(session.url)
        until(page, "window.nisus.link.status.finished && !window.nisus.view.following")
        labels = page.evaluate("window.nisus.charts.axis.plot.axes[0]._values")
        assert len(labels) > 5 and all(label == "" or label.endswith(" d") for label in labels)
        assert "8.33 d" in page.locator("#window").inner_text()
        # 30 days at real time would show a row an hour: 10,000 times faster they take 4 minutes.
        page.locator("#pause").click()
        wait_for(lambda: session.engine.status().speed == 1e4 and not session.engine.status().finished)
        until(page, "window.nisus.charts.newest > 20 * 3600")
        page.screenshot(path=tmp_path / "replay.png")


STRIP = """() => ["health", "nis", "cause", "stage-time"].map((id) => document.getElementById(id).textContent)"""


def strip_of(status):
    """Health, NIS per degree of freedom and cause, as the strip shows them."""
    ratio = status.nis.ratio
    return HEALTH_NAMES[status.health], float(f"{ratio:.3g}"), status.cause


def shows(page, status, caption):
    def there():
        health, nis, cause, time = page.evaluate(STRIP)
        name, ratio, text = strip_of(status)
        return (
            health.split()[1] == name
            and float(nis) == pytest.approx(ratio, rel=0.006)
            and bool(cause) == bool(text)
            and time == caption
        )

    wait_for(there)


def test_strip_and_scene_show_the_moment_of_the_cursor(visit, session):
    """Each page has its own strip; the scene is one, and says which moment it shows."""
    page = visit(session.url, scene=True)
    engine, view = session.engine, session.running.view
    end = float(pull_all(engine).events.t[-1]) * 1e-9
    origin = engine.span()[0]
    page.evaluate("window.nisus.view.follow()")
    wait_for(lambda: view.history.n > 0 and view.history.column("t")[-1] == engine.span()[1])
    shows(page, engine.status(), "")

    page.evaluate("window.nisus.view.show(20, 60, 41.03)")
    at = origin + round(41.03e9)
    then = engine.status_at(at)
    assert strip_of(then) != strip_of(engine.status()), "the test needs another NIS than at the end"
    shows(page, then, "at 0:41.0")
    wait_for(lambda: view.history.n and view.history.column("t")[-1] == then.t)
    # The charts' window before that moment, and nothing after it.
    assert view.history.column("t")[0] <= max(origin, then.t - view.history.span) + 10**9

    # Another window points elsewhere: the scene follows it, and the first window says so; its strip stays.
    other = visit(session.url, beside=page)
    other.evaluate("window.nisus.view.show(0, 60, 11)")
    shows(other, engine.status_at(origin + 11 * 10**9), "at 0:11.0")
    shows(page, then, "at 0:11.0, 30 s earlier than the charts")
    other.close()
    wait_for(lambda: view.renderer.choices.at is None)
    shows(page, then, f"at {int(end // 60)}:{end % 60:04.1f}, {round(end - 41.03)} s later than the charts")

    # Back at the newest row; a folded recording offers the whole of it, and no newest row.
    page.evaluate("window.nisus.view.show(20, 60, 41.03)")
    assert page.locator("#follow").inner_text() == "all"
    page.locator("#follow").click()
    until(page, f"window.nisus.charts.range[1] >= {end - 0.01} && window.nisus.view.at === 41.03")
    assert not page.locator("#follow").is_visible()
    page.locator("body").press("f")
    shows(page, engine.status(), "")


@pytest.fixture(scope="module")
def battery():
    with running("battery_dmegc") as session:
        yield session


@pytest.mark.parametrize("width", [390, 1440])
def test_charts_show_the_values_of_the_row_at_the_moment(visit, battery, width):
    """Drawn are the extremes of groups of rows; the text beside a chart is of the last row then, or at the pointer."""
    page = visit(battery.url, size=(width, 900))
    pull = pull_all(battery.engine)
    seconds = (pull.events.t - pull.events.t[0]) * 1e-9
    assert len(seconds) > 1000  # more than are drawn
    names = [state.name for state in battery.engine.model.shown_states]
    labels = {"v1": "polarisation voltage", "r0": "series resistance"}

    def shown(moment):
        row = int(np.flatnonzero(seconds <= moment)[-1])
        for name, label in labels.items():
            k = names.index(name)
            mean, half = pull.track.mean[row, k], 2.0 * pull.track.std[row, k]
            decimals = max(0, 1 - int(np.floor(np.log10(half))))
            wanted = f"{mean:.{decimals}f} ± {half:.{decimals}f}"
            reading = page.locator(f"[aria-label='Chart of {label}'] .reading")
            wait_for(lambda reading=reading, wanted=wanted: reading.inner_text().startswith(wanted))

    for moment in (700.25, 1400.25, 3200.25):
        page.evaluate("(at) => window.nisus.view.show(0, window.nisus.charts.newest, at)", moment)
        shown(moment)
    assert page.evaluate("window.nisus.charts.live.size") > 1
    box = page.locator("[aria-label='Chart of polarisation voltage'] .u-over").bounding_box()
    for share in (0.31, 0.62):
        page.mouse.move(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
        until(page, f"Math.abs(window.nisus.charts.hovered / window.nisus.charts.newest - {share}) < 0.02")
        shown(page.evaluate("window.nisus.charts.hovered"))
    page.mouse.move(5, 5)
    shown(3200.25)
