"""Hidden views request nothing; the page stays current after a twin has ended."""

import numpy as np
import pytest

from app.engine.commands import Pin, SetTuning, UseSensor
from estimators.attribution import attribution
from estimators.fold import Fold
from estimators.log import READING
from tests.app.scripted import pull_all
from tests.app.web.page.browsed import running, settled, until
from tests.support import SECOND, as_log
from tests.waiting import wait_for

pytestmark = pytest.mark.browser


@pytest.fixture
def session():
    with running("motor_joint", **{"source.duration": "300"}) as session:
        yield session


def streams(session):
    """Columns of each open chart stream."""
    return {stream.name: set(stream.query.columns) for stream in session.running.server.series.streams.copy()}


def test_the_charts_go_to_another_moment_of_the_stretch_that_they_show(page, session):
    """No new request is sent, and the legend shows the values at that time."""
    until(page, "window.nisus.charts.live.x.length > 100")
    page.evaluate("window.nisus.view.show(50, 150, 60)")
    until(page, "window.nisus.charts.range[0] === 50 && window.nisus.charts.live.x.at(-1) < 151")
    rows = pull_all(session.engine)
    name = page.evaluate("window.nisus.charts.charts[0].what.key").removeprefix("state:")
    k = list(session.engine.model.state_names).index(name)
    said = page.locator("#charts article .reading").first

    def says(seconds):
        at = int(np.searchsorted(rows.events.t, rows.events.t[0] + seconds * SECOND, side="right")) - 1
        mean, std = rows.track.mean[at, k], rows.track.std[at, k]
        value, between, _ = said.inner_text().partition(" ± ")
        return bool(between) and float(value) == pytest.approx(mean, abs=0.2 * std)

    wait_for(lambda: says(60))
    # The points of the stretch have come: nothing draws any more.
    until(page, "performance.now() - window.nisus.charts.drawnAt > 300")
    page.evaluate("window.nisus.view.goTo(140, window.nisus.charts.range)")
    wait_for(lambda: says(140))
    assert not says(60)


DRAWN_DOTS = """() => {
  const { live, charts } = window.nisus.charts;
  const chart = charts.find(({ what }) => what.key.startsWith("innovation:"));
  const { x, value } = chart.data;
  return [live.each, x.flatMap((time, k) => (typeof value[k] === "number" ? [[time, value[k]]] : []))];
}"""


def test_every_innovation_is_drawn_from_afar_in_a_new_tab_and_after_an_edit(page, session):
    """With the extremes of groups alone, white noise would look like two rows of marks."""
    page.evaluate("window.nisus.view.show(20, 280)")

    def drawn_dots():
        until(page, "window.nisus.charts.live.each > 2 && window.nisus.charts.live.x[0] < 25")
        rows = pull_all(session.engine)
        seconds = (rows.events.t - rows.events.t[0]) * 1e-9
        innovation = rows.track.innovation[:, 0]
        each, dots = page.evaluate(DRAWN_DOTS)
        times, values = np.array(dots).T
        mine = (rows.events.kind == READING) & (rows.events.channel == 0)
        expected = innovation[mine & (seconds >= times[0]) & (seconds <= times[-1])]
        return each, values, expected

    settled_at = session.engine.revisions.runs[-1].number
    for revision in (settled_at, settled_at + 1):
        each, values, expected = drawn_dots()
        assert each > 2 and values.size > 500
        np.testing.assert_allclose(values, expected, atol=1e-5)
        if revision == settled_at:
            session.engine.submit(SetTuning("R.winding", 3.0))
            settled(session.engine, settled_at + 1)
            until(page, f"window.nisus.revision === {settled_at + 1}")  # of what is drawn


def test_dragging_across_a_part_of_a_chart_zooms_to_exactly_that_part(page):
    """All charts share the selection, and only the one that was dragged may act on it."""
    page.evaluate("window.nisus.view.show(50, 250)")
    until(page, "window.nisus.charts.range[0] === 50")
    assert page.evaluate("window.nisus.charts.charts.filter((chart) => !chart.node.hidden).length") > 8
    box = page.locator("#charts .u-over").first.bounding_box()
    start, y = box["x"] + 0.4 * box["width"], box["y"] + box["height"] / 2
    page.mouse.move(start, y)
    page.mouse.down()
    page.mouse.move(start + 0.3 * box["width"], y, steps=5)
    page.mouse.up()
    until(page, "window.nisus.view.since !== 50")
    since, until_ = page.evaluate("[window.nisus.view.since, window.nisus.view.until]")
    pixel = 200 / box["width"]
    assert [since, until_] == pytest.approx([50 + 0.4 * 200, 50 + 0.7 * 200], abs=pixel)


def test_hidden_charts_ask_for_nothing(page, session):
    engine = session.engine
    engine.submit(Pin(0))
    engine.submit(SetTuning("Q.winding", 0.5))
    asked = {"overview", "charts", "previous", "run 0", "less 0"}
    # Of all 300 s the charts draw groups of rows, so the values at the cursor are a stream of their own.
    wait_for(lambda: streams(session).keys() == asked | {"moment"})
    page.get_by_role("tab", name="Diagnose").click()
    wait_for(lambda: streams(session).keys() == {"overview"})
    # The bar of time goes on, and knows what the charts would show.
    page.evaluate("window.nisus.view.show(10, 20)")
    assert page.evaluate("window.nisus.charts.range") == [10, 20]
    page.locator("#follow").click()
    assert page.evaluate("window.nisus.charts.range[1]") == pytest.approx(300, rel=0.01)
    drawn = page.evaluate("window.nisus.drawn")
    page.get_by_role("tab", name="Charts").click()
    wait_for(lambda: streams(session).keys() == asked | {"moment"})
    until(page, f"window.nisus.drawn > {drawn} && window.nisus.revision === 1")


def test_a_chart_that_is_not_chosen_is_not_sent(page, session):
    wait_for(lambda: "innovation:yoke" in streams(session).get("charts", ()))
    page.get_by_text("Shown", exact=True).click()
    for name in ("yoke", "magnet"):
        page.locator("#layout li", has_text=name).last.get_by_role("checkbox").uncheck()
    wait_for(lambda: not {"innovation:yoke", "mean:magnet"} & set(streams(session)["charts"]))
    assert "mean:yoke" in streams(session)["charts"]


def test_all_of_q_is_one_command_one_revision_and_one_undo(page, session):
    engine = session.engine
    before, first = engine.status().tuning, engine.revisions.runs[-1].number
    page.get_by_role("button", name="×10", exact=True).first.click()
    wait_for(lambda: engine.revisions.runs[-1].number == first + 1 and not engine.status().refolding)
    assert engine.tuning.q.tolist() == [pytest.approx(10 * value, rel=1e-5) for value in before.q]
    assert {change.key for change in engine.revisions.runs[-1].changes} == {f"Q.{n.name}" for n in engine.model.noises}
    page.locator("#undo").click()
    wait_for(lambda: engine.revisions.runs[-1].number == first + 2 and not engine.status().refolding)
    assert engine.tuning.q.tolist() == before.q.tolist()
    page.locator("#redo").click()
    wait_for(lambda: engine.revisions.runs[-1].number == first + 3 and not engine.status().refolding)
    assert engine.tuning.q[0] == pytest.approx(10 * before.q[0], rel=1e-5)
    # What can be undone comes with the status.
    wait_for(lambda: page.locator("#undo").is_enabled() and page.locator("#redo").is_disabled())


def test_what_became_of_the_readings_is_told(page, session):
    session.engine.submit(UseSensor("yoke", False))
    wait_for(lambda: session.engine.status().counts.get("held out"))
    page.get_by_role("tab", name="Episodes").click()
    told = page.locator(".counts")
    wait_for(lambda: "held out" in told.inner_text())
    counts = session.engine.status().counts
    words = told.inner_text().split("\n")
    assert words[:4] == ["measurements", f"{counts['readings']:,}", "used", f"{counts['used']:,}"]
    assert words[words.index("held out") + 1] == f"{counts['held out']} (33 %)"


def test_the_last_status_is_told_again(page):
    page.evaluate("window.told = []; window.nisus.link.addEventListener('status', (e) => window.told.push(e.detail.t))")
    until(page, "window.told.length >= 3")
    assert len(set(page.evaluate("window.told"))) == 1


def test_an_episode_that_is_told_at_rest_is_drawn(page, session):
    """Its strip is drawn on a chart after the twin has ended and no frame arrives."""
    until(page, "performance.now() - window.nisus.charts.drawnAt > 700")
    drawn = page.evaluate("window.nisus.drawn")
    strip = """(() => {
      const { plot } = window.nisus.charts.charts.find(({ what }) => what.key === "state:tooth");
      const { left, top, width } = plot.bbox;
      return [...plot.ctx.getImageData(Math.round(left + width / 2), Math.round(top), 1, 1).data];
    })()"""
    before = page.evaluate(strip)
    page.evaluate("""(() => {
      const { link, charts } = window.nisus;
      const [start, end] = charts.range.map((time) => time + Number(link.status.origin) / 1e9);
      const help = 'docs/alarms.md#shifted';
      link.episodes = [{ start, end, subject: 'tooth', cause: 'shifted', text: 'tooth is shifted', help }];
      link.tell('episodes', link.episodes);
    })()""")
    assert page.evaluate("window.nisus.drawn") > drawn
    after = page.evaluate(strip)
    assert after != before and after[0] > after[2]
    # Over again right after it was drawn: that is drawn too, a moment later.
    page.evaluate("window.nisus.charts.draw(); window.nisus.link.tell('episodes', (window.nisus.link.episodes = []))")
    wait_for(lambda: page.evaluate(strip) == before)


def test_what_moved_the_estimate_in_the_charts_is_explained(page, session):
    """The figures of the API, which are those of the attribution over the same log, and add up to the change."""
    page.evaluate("window.nisus.view.show(50, 60)")
    until(page, "window.nisus.charts.range[0] === 50")
    page.get_by_role("tab", name="Episodes").click()
    why = page.get_by_role("region", name="What moved the estimate")
    why.get_by_role("button", name="Explain").click()
    until(page, "window.nisus.explained === 1")
    engine, model = session.engine, session.engine.model
    rows = pull_all(engine)
    origin = int(rows.events.t[0])
    log = as_log(rows.events)
    fold = Fold(engine.estimator, model, engine.tuning, log, policy=engine.policy, expected=engine.twin.expected)
    found = attribution(fold, origin + 50 * SECOND, origin + 60 * SECOND)
    answer = page.evaluate("fetch('/api/why?since=50&until=60').then((answer) => answer.json())")
    for j, (name, state) in enumerate(answer["states"].items()):
        assert state["model"] == found.model[j] and state["before"] == found.before[j]
        assert list(state["inputs"].values()) == found.inputs[:, j].tolist()
        assert list(state["sensors"].values()) == found.sensors[:, j].tolist()
        parts = [state["model"], state["restarts"], *state["inputs"].values(), *state["sensors"].values()]
        assert sum(parts) == pytest.approx(state["after"] - state["before"], abs=1e-9), name
    said = why.locator("li").nth(1).inner_text()
    name, state = next(iter(answer["states"].items()))
    most = max({**state["inputs"], **state["sensors"], "model": state["model"]}.items(), key=lambda item: abs(item[1]))
    assert said.startswith(name.replace("_", " ")) and f": {most[0].replace('_', ' ')} " in said
    for span, text in (
        ("since=-20&until=-10", "the estimate of this span is not there"),
        ("since=9&until=9", "no event"),
    ):
        assert text in page.evaluate(f"fetch('/api/why?{span}').then((answer) => answer.json())")["error"]
