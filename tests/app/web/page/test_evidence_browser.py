"""Held-out sensors, R with correlated innovations, and charts of many states on the page."""

import json
import re
from contextlib import ExitStack

import numpy as np
import pytest

from app.engine.commands import SetTuning
from tests.app.scripted import pull_all
from tests.app.web.page.browsed import running, until
from tests.app.web.page.test_quiet_browser import streams
from tests.waiting import wait_for

pytestmark = pytest.mark.browser


@pytest.fixture
def shown(visit):
    """Runs a twin to its end and opens its page."""
    with ExitStack() as stack:

        def show(name, **overrides):
            session = stack.enter_context(running(name, **overrides))
            return visit(session.url), session

        yield show


def test_a_sensor_that_is_held_out_is_not_passed_over_in_silence(shown):
    fault = "[{kind: bias, sensor: yoke, size: 6, start: 100}]"
    page, session = shown("motor_joint", **{"source.duration": "200.0", "faults": fault})
    page.get_by_role("tab", name="Episodes").click()
    page.get_by_text("Now (").wait_for()
    session.engine.submit(SetTuning("use.yoke", False))
    page.get_by_text("Now: no faults in the sensors in use").wait_for()
    text = session.engine.status().sensors["yoke"][1]
    assert re.fullmatch(
        r"yoke, held out: [\d.]+ °C above the prediction of the other sensors, ±[\d.]+ °C expected", text
    )
    page.locator("#episodes .held-out").get_by_text(text, exact=True).wait_for()
    until(
        page,
        f"[...document.querySelectorAll('#lights .light')].some((light) => light.title.includes({json.dumps(text)}))",
    )


def test_where_the_innovations_are_correlated_no_value_of_r_is_offered_and_it_says_why(shown):
    """The same page with and without a doubt: the mark takes the value, or gives the reason and takes none."""
    page, session = shown("motor_joint", **{"source.duration": "100.0"})
    doubt = "the innovations are correlated (+0.86 with the next, where chance allows ±0.03): look elsewhere"
    told = {
        key: {"value": 0.5, "std": 0.01, "n": 900, "doubt": doubt if key == "R.yoke" else ""}
        for key in ("R.yoke", "R.tooth")
    }
    q = {"key": "Q", "revision": 0, "level": 0.3, "done": True, "points": [], "doubt": doubt}
    body = {"revision": 0, "R": told, "reason": "", "Q": q}
    page.route("**/api/noise", lambda route: route.fulfill(json=body))
    page.reload()
    mark = page.locator('[data-key="R.yoke"] .data-says')
    until(page, """document.querySelector('[data-key="R.yoke"] .data-says')?.textContent === "◇" """)
    assert mark.get_attribute("title") == f"No value from the data: {doubt}"
    before = session.engine.revisions.runs[-1].number
    other = page.locator('[data-key="R.tooth"] .data-says')
    # A forced press waits for nothing: beside a mark of 8 px that still moves lie the slider and the label.
    for item in (mark, other):
        item.element_handle().wait_for_element_state("stable")
    mark.click(force=True)
    # Another one, of which nothing speaks against it, is taken: then the first would have been, too.
    other.click(force=True)
    wait_for(lambda: session.engine.revisions.runs[-1].number > before)
    assert session.engine.tuning.get("R.tooth") == 0.5 and session.engine.tuning.get("R.yoke") != 0.5
    assert page.locator("#scale-Q").is_disabled() and doubt in page.locator("#scale-Q").get_attribute("title")
    page.locator('[data-key="R.yoke"] label').click()
    curve = page.locator('[data-key="R.yoke"] .around')
    until(page, """document.querySelector('[data-key="R.yoke"] .around')?.dataset.done === "true" """)
    assert curve.locator(".takes").inner_text() == doubt and curve.locator(".takes button:not([hidden])").count() == 0


def test_many_states_of_a_kind_are_one_chart_in_which_the_odd_one_stands_out(shown):
    page, session = shown("battery_pack", **{"source.duration": "600"})
    until(page, "window.nisus.charts.live.x.length > 0")
    keys = [key for key, _ in page.evaluate("window.nisus.charts.layout.shown()")]
    assert keys[:3] == ["group:soc", "group:v1", "group:temperature"] and not [key for key in keys if "state:" in key]
    wanted = {column for column in streams(session)["charts"] if column.startswith(("mean:", "upper:"))}
    states = [state.name for state in session.engine.model.shown_states]
    assert wanted == {f"mean:{name}" for name in states}  # and none of the bands of charts that are hidden
    last = pull_all(session.engine).track.mean[-1]
    soc = {name: last[k] for k, name in enumerate(states) if name.startswith("soc")}
    lowest, highest = min(soc, key=soc.get), max(soc, key=soc.get)
    assert lowest == "soc_5"  # the weak cell
    # Points are groups of rows: the newest row comes with an answer of its own.
    until(page, """document.querySelector("#charts article .reading").textContent !== "" """)
    text = page.locator("#charts article").first.locator(".reading").inner_text()
    low, median, high = (float(number) for number in re.findall(r"(?<=[ ])(\d\.\d+)", text))
    names = [name.removeprefix("soc_") for name in (lowest, highest)]
    assert re.search(rf"^lowest \S+ \({names[0]}\) .* highest \S+ \({names[1]}\)$", text)
    # To three decimals, two digits of their spread.
    assert (low, median, high) == pytest.approx(
        (soc[lowest], float(np.median(list(soc.values()))), soc[highest]), abs=5e-4
    )
    strong = page.evaluate("window.nisus.charts.charts[0].data.furthest.at(-1)")
    assert strong == pytest.approx(soc[lowest], rel=1e-6)
    # The band is that of the strong one alone, and no other is asked for.
    until(page, "window.nisus.charts.strong.edges('soc_5')[0].length > 0")
    assert {column for column in streams(session)["strong"] if "soc" in column} == {"upper:soc_5", "lower:soc_5"}
    upper, lower = page.evaluate("window.nisus.charts.strong.edges('soc_5').map((values) => values.at(-1))")
    half = 2 * pull_all(session.engine).track.std[-1, states.index("soc_5")]
    assert (upper, lower) == pytest.approx((soc[lowest] + half, soc[lowest] - half), rel=1e-5)
    blue = page.evaluate(
        """() => {
            const { plot, what } = window.nisus.charts.charts[0];
            const { ctx, bbox } = plot;
            const [x] = plot.data;
            const middle = x[Math.floor(0.7 * x.length)];
            const { x: times } = window.nisus.charts.strong.stream;
            const at = times.findLastIndex((time) => time <= middle);
            const lower = window.nisus.charts.strong.edges("soc_5")[1][at]; // beneath it there is no other line
            const strong = what.data().furthest[Math.floor(0.7 * x.length)];
            const left = plot.valToPos(middle, "x", true);
            const place = (value) => ctx.getImageData(left, plot.valToPos(value, "y", true), 1, 1).data;
            const [inside, outside] = [(lower + strong) / 2, lower - (strong - lower) / 2].map(place);
            return [inside[2] - inside[0], outside[2] - outside[0]];
        }"""
    )
    assert blue[0] > blue[1] + 15
    # Each of them can be had.
    page.get_by_text("Shown", exact=True).click()
    page.locator("#layout li").filter(has_text="state of charge 5").first.get_by_role("checkbox").check()
    wait_for(lambda: "upper:soc_5" in streams(session)["charts"])


def test_a_dozen_states_and_more_are_a_picture_of_space_and_time(shown):
    page, session = shown("lorenz96", **{"source.duration": "20"})
    until(page, "window.nisus.charts.live.x.length > 100")
    assert page.evaluate("window.nisus.charts.layout.shown()[0][0]") == "group:x"
    page.evaluate("window.nisus.view.show(window.nisus.charts.live.x.at(-1) - 2, window.nisus.charts.live.x.at(-1))")
    until(page, "window.nisus.charts.live.x[0] > 17 && window.nisus.charts.live.size === 1")
    data, values = page.evaluate(
        """() => {
            const { charts: [{ plot, what, data }] } = window.nisus.charts;
            const { ctx, bbox } = plot;
            const left = Math.round(bbox.left + 0.95 * bbox.width);
            const shown = plot.posToVal((left - bbox.left) / devicePixelRatio, "x");
            const at = data.x.findLastIndex((time) => time <= shown);
            const rows = what.columns.map((_, k) => bbox.top + bbox.height * (1 - (k + 0.5) / what.columns.length));
            const colours = rows.map((top) => [...ctx.getImageData(left, Math.round(top), 1, 1).data]);
            return [colours, [...what.columns.map((name) => data[name.split(":")[1]][at]), data.x[at]]];
        }"""
    )
    pull = pull_all(session.engine)
    row = np.searchsorted(pull.events.t, pull.events.t[0] + round(values.pop() * 1e9) + 1) - 1
    np.testing.assert_allclose(values, pull.track.mean[row], rtol=1e-5, atol=1e-6)
    assert len(values) == 40
    light = np.array(data)[:, :3].sum(axis=1)
    # The scale goes from dark to light: lightness has the order of the values.
    assert np.all(np.diff(light[np.argsort(values)]) >= -2)
    # Beneath it how far they are apart, and how sure the estimate is of one.
    assert page.evaluate("window.nisus.charts.layout.shown()[1][0]") == "spread:x"
    until(page, "window.nisus.charts.charts[1].data.upper?.at(-1) != null")
    rows = page.evaluate(
        "['highest', 'lowest', 'upper', 'lower', 'mean'].map((name) => window.nisus.charts.charts[1].data[name].at(-1))"
    )
    track = pull_all(session.engine).track
    mean, half = track.mean[-1].mean(), 2 * np.sqrt(np.mean(track.std[-1] ** 2))
    expected = (track.mean[-1].max(), track.mean[-1].min(), mean + half, mean - half, mean)
    np.testing.assert_allclose(rows, expected, rtol=1e-4, atol=1e-4)
