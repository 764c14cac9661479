"""One wild reading does not flatten a chart: the axis is that of the others, and the wild one is marked at its edge."""

import numpy as np
import pytest

from app.derive.forecast import ForecastQuestion, Forecasts
from app.web.streams import belief_json
from estimators.log import READING
from tests.app.scripted import pull_all
from tests.app.web.page.browsed import running, until
from tests.waiting import wait_for

pytestmark = pytest.mark.browser

SPIKES = "[{kind: spike, sensor: winding, size: 6000.0, rate: 0.01}]"


@pytest.fixture(scope="module")
def session():
    with running("motor_winding", **{"faults": SPIKES, "gate": "0.9999", "source.duration": "600"}) as session:
        yield session


def chart(page, key):
    """Value axis of a chart, and the marks at its edges."""
    return page.evaluate(
        """(key) => {
          const chart = window.nisus.charts.charts.find((chart) => chart.what.key === key);
          const { x, y } = chart.plot.scales;
          return { low: y.min, high: y.max, marks: chart.outsiders, since: x.min, until: x.max };
        }""",
        key,
    )


def test_a_wild_reading_is_marked_at_the_edge_and_the_others_rule_the_axis(page, session):
    pull = pull_all(session.engine)
    innovation = pull.track.innovation[pull.events.kind == READING, 0]
    innovation = innovation[np.isfinite(innovation)]  # without those beyond what the sensor can say at all
    ordinary = np.abs(innovation[np.abs(innovation) < 30.0]).max()
    assert np.abs(innovation).max() > 20 * ordinary
    page.evaluate("window.nisus.view.follow(null)")
    wait_for(lambda: page.evaluate("window.nisus.charts.live.x[0]") < 1.0)

    def drawn(key):
        """The chart, once the picture is that of all of it."""
        found = {}
        wait_for(lambda: found.update(chart(page, key)) or found["since"] < 1.0 and found["until"] > 590.0)
        return found

    shown = drawn("innovation:winding")
    # Wide enough for all but the wild ones, and not much wider: 8 % of margin, and axes shrink when half is empty.
    assert ordinary <= shown["high"] == -shown["low"] < 3 * ordinary
    furthest = {mark["above"]: mark["value"] for mark in shown["marks"] if mark.get("furthest")}
    assert furthest[True] == pytest.approx(innovation.max(), rel=1e-6)
    assert furthest[False] == pytest.approx(innovation.min(), rel=1e-6)
    assert {mark["tone"] for mark in shown["marks"]} == {"reading"}

    # The same of the state, by the mark of a refused reading.
    state = drawn("state:temperature")
    assert state["high"] - state["low"] < 500.0
    assert {mark["tone"] for mark in state["marks"]} == {"refused"}


def test_what_an_axis_spans(page):
    """Of columns whose answer is plain."""
    found = page.evaluate(
        """async () => {
          const { shownExtent } = await import("/page/ranges.js");
          const ramp = Array.from({ length: 100 }, (_, k) => k / 100);
          const wild = ramp.map((value, k) => (k === 50 ? 1e6 : value));
          const settling = ramp.map((value, k) => (k < 5 ? -1e4 : value));
          const step = ramp.map((value, k) => (k < 98 ? 0 : 7));
          const few = ramp.map((value, k) => (k % 10 ? null : k === 50 ? 1e6 : value));
          const flat = ramp.map((value, k) => (k === 50 ? 3 : 0));
          const none = ramp.map(() => null);
          const of = (drawn) => shownExtent(drawn, 0, 99);
          return {
            wild: of({ dots: [wild] }), settling: of({ lines: [settling] }), step: of({ lines: [step] }),
            few: of({ dots: [few] }), flat: of({ dots: [flat] }), none: of({ lines: [none], dots: [none] }),
            both: of({ lines: [ramp], dots: [wild] }), part: shownExtent({ lines: [ramp] }, 20, 30),
          };
        }"""
    )
    assert found["wild"] == [0.0, 0.99] and found["both"] == [0.0, 0.99]
    assert found["settling"] == pytest.approx([0.05, 0.99])
    # A line that has just moved is in view, a handful of dots too, and what is alone beside nothing.
    assert found["step"] == [0, 7] and found["few"] == [0, 1e6] and found["flat"] == [0, 3]
    assert found["none"][0] > found["none"][1]
    assert found["part"] == pytest.approx([0.2, 0.3])


def test_a_fault_is_marked_on_the_charts_that_it_concerns(page):
    """A sensor's at its rows and the states that they measure, the twin's at NIS; an input has no chart."""
    found = page.evaluate(
        """() => {
          const { charts } = window.nisus;
          const marked = (subject) => {
            charts.episodes = [{ subject, from: 1, to: null }];
            charts.draw();
            return charts.charts.filter(({ plot }) => plot.marked).map(({ what }) => what.key);
          };
          return ["winding", "temperature", "twin", "current"].map(marked);
        }"""
    )
    assert found == [["state:temperature", "innovation:winding"], ["state:temperature"], ["nis"], []]


def test_dots_that_are_many_are_small_and_see_through(page):
    """In half a minute there is room for all; in ten minutes the bounds of innovations stay visible beneath 1,200."""
    sizes = {}
    for seconds in (30, 600):
        page.evaluate("(until) => window.nisus.view.show(0, until)", seconds)
        # The sizes are those of the picture, which follows the rows: axis and rows of the chart itself reach that far.
        until(
            page,
            f"""(() => {{
              const {{ plot }} = window.nisus.charts.charts.find(({{ what }}) => what.key === "innovation:winding");
              const reach = [plot.scales.x.max, plot.data[0].at(-1)];
              return reach.every((end) => end >= {0.95 * seconds} && end <= {1.05 * seconds});
            }})()""",
        )
        sizes[seconds] = page.evaluate(
            """() => {
              const { plot } = window.nisus.charts.charts.find(({ what }) => what.key === "innovation:winding");
              return [plot.series[1].points.size, plot.series[1].points.fill(plot, 1)];
            }"""
        )
    (few, opaque), (many, clear) = sizes[30], sizes[600]
    assert few == 3 and many < few
    assert len(opaque) == 7 and clear[:7] == opaque and 0.5 < int(clear[7:], 16) / 255 < 1


def test_the_time_of_an_alarm_is_that_of_the_charts(page):
    """Charts count from the first event, here at 23:59:50 UTC of a day; an alarm of a later day has its day."""
    found = page.evaluate(
        """async () => {
          const { inChartTime } = await import("/page/format.js");
          const origin = "1700006390000000000";
          const text = (day) => `yoke is rejected since 2023-11-${day} 00:00:25 UTC (100 %)`;
          return [
            inChartTime(text("15"), origin), inChartTime(text("18"), origin), inChartTime(text("15"), null),
            inChartTime("yoke is silent since 72.5 s", "10000000000"),
          ];
        }"""
    )
    assert found == [
        "yoke is rejected since 0:35 (100 %)",
        "yoke is rejected since 3 d 00:00 (100 %)",
        "yoke is rejected since 2023-11-15 00:00:25 UTC (100 %)",
        "yoke is silent since 1:02.5",
    ]


def test_sentences_have_the_words_of_names_and_clocks_count_days(page):
    found = page.evaluate(
        """async () => {
          const { clock, inChartTime, setLabels } = await import("/page/format.js");
          setLabels({ labels: { soc: "state of charge" }, states: [{ name: "soc" }, { name: "ocv_error" }], rows: [] });
          const text = "soc and ocv_error drift; reduce Q.ocv_error, see a_file.csv";
          return [inChartTime(text, "0"), clock(86399), clock(90000)];
        }"""
    )
    assert found == [
        "state of charge and ocv error drift; reduce Q.ocv_error, see a_file.csv", "23:59:59", "1 d 01:00",
    ]  # fmt: skip


@pytest.mark.parametrize(("limit", "warmest"), [("1e-3", "20"), ("1e9", "0")], ids=["uncertain", "far outside"])
def test_a_withheld_estimate_has_its_reason_in_place_of_a_value_and_a_band_without_a_line(
    visit, tmp_path, limit, warmest
):
    valid = f"{{temperature: [-10, {warmest}]}}"
    limits = {"withhold": f"{{rate: {limit}}}", "valid_range": valid, "source.duration": "60"}
    with running("motor_winding", **limits) as session:
        page = visit(session.url)
        reason = session.engine.status().withheld["rate"]
        assert reason.startswith("outside the fitted range (temperature ")
        shown = "[...document.querySelectorAll('#charts article.chart')].map((chart) => chart.innerText)"
        until(page, f"{shown}.some((text) => text.includes('withheld: {reason}'))")
        page.screenshot(path=tmp_path / "withheld.png")
        # No other chart, and no line: the columns of the mean are empty, those of the band are not.
        assert sum("withheld" in text for text in page.evaluate(shown)) == 1
        column = "window.nisus.charts.live.column('{}:rate').filter(Number.isFinite).length"
        assert page.evaluate(column.format("mean")) == 0 < page.evaluate(column.format("upper"))
        # The mark at its name, with the reason; the other state has the health of the twin.
        marks = "[...document.querySelectorAll('.grade:not([hidden])')].map((own) => [own.innerText, own.title])"
        until(page, f"{marks}.length === 2")
        (_, own), (said, other) = sorted(page.evaluate(marks), key=lambda mark: "withheld" in mark[0])
        assert own.startswith("suspect: temperature is ") and (said, other) == ("⊘ withheld", f"withheld: {reason}")
        # Two states against each other and a forecast leave it out as well; the forecast keeps its band.
        page.get_by_role("tab", name="XY").click()
        until(page, f"document.getElementById('xy').innerText.includes('rate withheld: {reason}')")
        engine = session.engine
        assert np.isnan(engine.belief().mean[1]) and np.isfinite(engine.belief().mean[0])
        assert belief_json(engine, [0, 1]) is None
        told = Forecasts(engine).compute(ForecastQuestion(5.0))["states"]
        assert set(told["rate"]["mean"]) == {None} and None not in told["rate"]["upper2"] + told["temperature"]["mean"]
