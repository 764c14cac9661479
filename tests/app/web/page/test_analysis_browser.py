"""What if and Diagnose in headless Chromium: they draw, follow what is asked, and rest while hidden."""

import numpy as np
import pytest

from estimators.log import INPUT
from tests.app.scripted import pull_all, row_count
from tests.app.web.page.browsed import running, until
from tests.waiting import wait_for

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def session():
    with running("motor_can", 1.0) as made:
        wait_for(lambda: row_count(made.engine) > 600)
        yield made


def questions(page, path):
    return sum(url.endswith(path) for url in page.asked)


def test_what_if_draws_a_fan_and_says_when_a_limit_is_reached(page, session):
    assert questions(page, "/api/forecast") == 0
    page.get_by_role("tab", name="What if").click()
    until(page, "window.nisus.forecasts > 0")
    fans = page.locator("#whatif .chart")
    assert fans.count() == 4 and fans.first.get_by_text("magnet", exact=True).is_visible()
    # The fan: blue pixels to the right of now, on every canvas.
    right = """() => [...document.querySelectorAll("#whatif canvas")].slice(0, 4).map((canvas) => {
        const { width, height } = canvas;
        const { data } = canvas.getContext("2d").getImageData(width >> 1, 0, width >> 1, height);
        let blue = 0;
        for (let k = 0; k < data.length; k += 4) if (data[k + 3] > 100 && data[k + 2] > data[k] + 60) blue++;
        return blue;
    })"""
    wait_for(lambda: min(page.evaluate(right)) > 50)
    # A current ten times as strong heats the winding beyond any doubt.
    page.get_by_label("i q [A] from now on, as a number").fill("600")
    page.get_by_label("i q [A] from now on, as a number").press("Enter")
    page.get_by_label("Limit of winding °C", exact=True).fill("90")
    page.get_by_label("Limit of winding °C", exact=True).press("Enter")
    said = page.get_by_label("When winding reaches its limit")
    wait_for(lambda: said.inner_text().startswith("reaches 90 °C in "))
    assert "over 99 % within 6 min" in said.inner_text()
    # And as it is now again: less hot.
    hot = page.evaluate("window.nisus.panes.whatif.found.states.winding.mean.at(-1)")
    page.get_by_label("i q as it is now").click()
    until(page, f"window.nisus.panes.whatif.found.states.winding.mean.at(-1) < {hot} - 50")
    assert session.engine.status().health != 4


def chosen(page):
    """Course of i q that the forecast used."""
    return page.evaluate("window.nisus.panes.whatif.found.chosen.i_q ?? null")


def test_an_input_steps_ramps_or_repeats_what_was_recorded(page, session):
    page.get_by_role("tab", name="What if").click()
    kind, field = page.get_by_label("How i q goes on"), page.get_by_label("i q [A] from now on, as a number")
    charts = page.locator("#whatif .chart")
    assert charts.count() == 4 and page.get_by_label("Seconds until i q is there").is_hidden()

    field.fill("600")
    field.press("Enter")
    until(page, 'JSON.stringify(window.nisus.panes.whatif.found.chosen.i_q) === \'{"t":[0],"value":[600]}\'')
    kind.select_option("step")
    after = page.get_by_label("Seconds until i q is there")
    after.fill("60")
    after.press("Enter")
    until(page, "window.nisus.panes.whatif.found.chosen.i_q?.t[0] === 60")
    # Before the step nothing differs, after it the winding is hotter by far.
    winding = page.evaluate("window.nisus.panes.whatif.found.states.winding.mean")
    t = page.evaluate("window.nisus.panes.whatif.found.t")
    assert winding[-1] > winding[max(k for k, time in enumerate(t) if time <= 60.0)] + 50.0
    drawn = page.evaluate(
        "window.nisus.panes.whatif.rows.get('i_q').chart.data.chosen.filter((value) => value !== null)"
    )
    assert drawn[-1] == drawn[-2] == 600.0 and drawn[0] == drawn[1] != 600.0
    assert page.get_by_label("Chart of i q", exact=True).is_visible() and charts.count() == 5

    kind.select_option("ramp")
    until(page, "window.nisus.panes.whatif.found.chosen.i_q?.t.length === 100")
    ramp = chosen(page)
    assert ramp["t"][-1] == 60.0 and ramp["value"][-1] == 600.0
    assert all(abs(b - a - 0.6) < 1e-3 for a, b in zip(ramp["t"], ramp["t"][1:], strict=False))

    kind.select_option("repeat")
    until(page, "window.nisus.panes.whatif.found.chosen.i_q?.t.length !== 100")
    assert field.is_disabled()
    recorded = pull_all(session.engine).events
    k = session.engine.model.input_names.index("i_q")
    known = recorded.value[(recorded.kind == INPUT), k]
    told = chosen(page)["value"]
    assert told and all(np.nanmin(np.abs(known - value)) < 1e-4 * abs(value) for value in told)

    page.get_by_label("i q as it is now").click()
    until(page, "!window.nisus.panes.whatif.found.chosen.i_q")
    wait_for(lambda: charts.count() == 4)


def test_how_likely_a_limit_is_passed_stands_at_the_foot_of_its_chart(page):
    page.get_by_role("tab", name="What if").click()
    page.get_by_label("Limit of winding °C", exact=True).fill("90")
    page.get_by_label("Limit of winding °C", exact=True).press("Enter")
    until(page, "window.nisus.panes.whatif.found?.limits.winding?.limit === 90")
    # The height of its curve at the right edge, in shares of a quarter of the chart.
    page.get_by_label("i q [A] from now on, as a number").fill("600")
    page.get_by_label("i q [A] from now on, as a number").press("Enter")
    until(page, "window.nisus.panes.whatif.found.limits.winding.probability.at(-1) > 0.99")
    height = """() => {
        const chart = window.nisus.panes.whatif.parts.find((part) => part.what.key === "whatif:winding");
        const { ctx, bbox } = chart.plot;
        const x = Math.round(chart.plot.valToPos(window.nisus.panes.whatif.times.at(-1), "x", true)) - 3;
        const ink = getComputedStyle(document.documentElement).getPropertyValue("--ink");
        const rgb = ink.match(/[0-9a-f]{2}/g).map((part) => parseInt(part, 16));
        const { data } = ctx.getImageData(x, bbox.top, 1, bbox.height);
        for (let k = Math.ceil(0.6 * bbox.height); k < bbox.height; k++) {
            const off = rgb.map((part, i) => Math.abs(data[4 * k + i] - part));
            if (Math.max(...off) < 40) return (bbox.height - k) / bbox.height;
        }
        return 0;
    }"""
    wait_for(lambda: abs(page.evaluate(height) - 0.25) < 0.03)
    page.get_by_label("i q as it is now").click()
    until(page, "!window.nisus.panes.whatif.found.chosen.i_q")


def test_diagnose_draws_what_the_rows_say(page, tmp_path):
    page.get_by_role("tab", name="Diagnose").click()
    until(page, "window.nisus.diagnosed > 0")
    for name in ("winding", "tooth", "yoke"):
        row = page.get_by_label(f"Innovations of {name}", exact=True)
        assert row.locator("svg").count() == 4 and row.locator("figcaption").count() == 4
        assert "good: " in row.locator("figcaption").first.inner_text()
        assert row.locator("svg rect.bar").count() > 5
        # Correlations at 50 lags; coverage of ten parts of the time, each with its interval once it has 8 readings.
        assert row.locator("svg[aria-label^=Autocorrelation] line.stem").count() == 50
        over = row.locator("svg[aria-label^=Coverage]")
        wait_for(lambda over=over: over.locator("line.stem").count() == 10)
        assert over.locator("circle").count() == 10
        assert "adaptive 95 % interval" in row.inner_text()
    page.locator("#diagnose").screenshot(path=tmp_path / "diagnose.png")
    assert page.locator("#diagnose svg.map rect").count() == 16
    # What takes many folds comes later.
    wait_for(lambda: page.get_by_label("Smallest visible faults", exact=True).count() == 1)
    wait_for(lambda: page.locator("#diagnose .shares tr").count() == 4)
    wait_for(lambda: "µs" in page.locator("#diagnose .summary").inner_text())


@pytest.mark.parametrize("place", ["inside", "above"])
def test_rows_in_order_do_not_hide_a_mean_nis_that_is_not(page, place):
    def answer(route):
        told = route.fetch().json()
        route.fulfill(json=told | {"rows": [row | {"tone": "good"} for row in told["rows"]], "nis_place": place})

    page.route("**/api/diagnose", answer)
    page.get_by_role("tab", name="Diagnose").click()
    until(page, "window.nisus.diagnosed > 0")
    said = page.locator("#diagnose .summary b").inner_text().strip()
    but = ", but the mean NIS is above its bounds" if place == "above" else ""
    assert said == f"3 of 3 sensor rows are consistent{but}."


def test_diagnose_states_which_considered_parameters_the_bands_come_from(page):
    def answer(route):
        told = route.fetch().json()
        variance = {"winding": "yoke_coolant 60 %, noise 40 %", "magnet": "noise 100 %"}
        gain = {"winding": "yoke_coolant: σ 0.9 to 0.57", "magnet": "no parameter reduces σ"}
        route.fulfill(json=told | {"variance": variance, "gain": gain})

    page.route("**/api/diagnose", answer)
    page.get_by_role("tab", name="Diagnose").click()
    until(page, "window.nisus.diagnosed > 0")
    card = page.get_by_label("Sources of uncertainty", exact=True)
    assert card.locator("tr").nth(1).inner_text().split("\t") == [
        "winding", "yoke coolant 60 %, noise 40 %", "yoke coolant: σ 0.9 to 0.57"
    ]  # fmt: skip
    assert card.locator("tr").count() == 3


def test_nothing_is_asked_while_both_are_hidden(page):
    page.get_by_role("tab", name="Charts").click()
    until(page, "!('whatif' in window.nisus.link.streams) && !window.nisus.panes.whatif.busy")
    asked = [questions(page, path) for path in ("/api/forecast", "/api/diagnose")]
    drawn = page.evaluate("window.nisus.drawn")
    # Long enough for several of either, by what the charts have drawn meanwhile at ten a second at most.
    until(page, f"window.nisus.drawn > {drawn} + 60")
    assert [questions(page, path) for path in ("/api/forecast", "/api/diagnose")] == asked
