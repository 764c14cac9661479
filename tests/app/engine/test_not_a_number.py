"""An estimate that is not a number: nothing is drawn for it, it is said since when, and what ran before is forgotten.

The model has no number beyond 8 m, and the asset goes to 12 m and back: the extended Kalman filter, once there, has
none any more until it is reset; the particle filter loses its cloud and starts it anew.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
import viser
from rerun.chunk import RrdReader

from app.drawing.heatmap import ESTIMATE, NOTHING, Scale
from app.engine.commands import SetEstimator
from app.engine.engine import Engine
from app.rerun.feed import RerunFeed
from app.rerun.field import FieldDrawing
from app.rerun.sink import Sink
from app.rerun.style import pair_name
from app.server.api import status_json
from app.viser.decimate import extended, runs
from app.viser.field_chart import FieldChart
from app.viser.status import status_html
from app.viser.time_units import SECONDS
from app.viser.view import ViserView
from config.schema import SceneSection, ViewSection
from estimators.diagnostics.field_pictures import Picture
from estimators.log import READING, RESET
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.track import DIVERGED
from estimators.tuning import Tuning
from tests.app.fake_engine import FakeEngine, events
from tests.app.scripted import Scripted, fresh_status, readings, twin
from tests.support import SECOND

RESET_AT, END = 20, 24


def f(x, u, p, dt, out):
    for k in range(3):
        out[k] = x[k]
    if x[0] > 8.0:
        for k in range(3):
            out[k] = np.nan


def fix(x, u, p, out):
    out[0] = x[0]
    out[1] = x[1]


RAIL = StateSpaceModel(
    name="rail", title="Rail", f=f,
    states=(State("east", "m", 0, 5), State("north", "m", 0, 1), State("height", "m", 0, 1)),
    noises=(Noise("east", "m²/s", 1.0), Noise("north", "m²/s", 0.1), Noise("height", "m²/s", 0.1)),
    sensors=(Sensor("gnss", (Row("east", "m", 0.25), Row("north", "m", 0.25)), fix),),
)  # fmt: skip


def f_of_one(x, u, p, dt, out):
    """Only one state has no number: that is no estimate either."""
    for k in range(3):
        out[k] = x[k]
    if x[0] > 8.0:
        out[0] = np.nan


ONE = replace(RAIL, name="rail_of_one", f=f_of_one)


@pytest.fixture(params=[RAIL, ONE], ids=["all states", "one state"], autouse=True)
def rail(request, monkeypatch):
    monkeypatch.setitem(globals(), "RAIL", request.param)


def fixes(first, last):
    t = np.arange(first, last + 1.0)
    return events(RAIL, READING, 0, t, np.stack((12.0 - np.abs(t - 12.0), 0 * t), axis=1))


def reset(at=RESET_AT):
    return events(RAIL, RESET, 0, [at], [np.nan])


def by_hand(estimator, *batches):
    """An engine without threads, that has taken these readings."""
    made = twin()
    made.model, made.tuning, made.estimator = RAIL, Tuning.of(RAIL).with_options({}), estimator
    made.config.view = SimpleNamespace(window=60.0)
    engine = Engine(made, lambda report: Scripted())
    for batch in batches:
        engine._accept([batch])
    return engine


def swap(engine, estimator):
    engine.retune(estimator, engine.tuning.with_options({}))
    engine._adopt(engine._refolder._fold(*engine._refolder._pending))


def lost_rows(track):
    return np.flatnonzero(~np.isfinite(track.mean).all(axis=1))


@pytest.fixture(params=["belief", "vehicle"])
def view(request):
    scene = SceneSection(kind="vehicle", position=("east", "north")) if request.param == "vehicle" else SceneSection()
    engine = FakeEngine(RAIL, "pf", ViewSection(window=60.0, scene=scene))
    engine.put(fixes(1, RESET_AT - 1))
    view = ViserView(engine, secret="x")
    view.frame()
    yield view
    view.stop()


def shown(scene):
    """Whether what stands for the estimate is seen: its place, its ellipse, its cloud."""
    if hasattr(scene, "_belief"):
        return scene._belief.visible, scene._belief.visible, scene._belief.visible and scene._points.visible
    return scene._vehicle.visible, scene._ellipse.visible and scene._rim.visible, scene._cloud.visible


def test_the_scene_drops_the_filter_before_and_shows_what_is_there_again(view):
    assert shown(view.scene) == (True, True, True)
    view.engine.submit(SetEstimator("ekf"))
    assert np.isnan(view.engine.belief().mean).any()
    view.frame()
    assert shown(view.scene) == (False, False, False)
    view.engine.put(reset())
    view.engine.put(fixes(RESET_AT + 1, END))
    view.frame()
    assert np.isfinite(view.engine.belief().mean).all()
    # A Gaussian filter has no cloud.
    assert shown(view.scene) == (True, True, False)


def test_the_charts_leave_a_gap_where_the_estimate_is_not_a_number(view):
    view.engine.submit(SetEstimator("ekf"))
    view.engine.put(reset())
    view.engine.put(fixes(RESET_AT + 1, END))
    view.frame()
    engine, chart = view.engine, view.charts._charts[2]
    lost = lost_rows(engine.fold.track)
    assert 8 <= lost[0] and lost[-1] == RESET_AT - 2 and lost.size == RESET_AT - 1 - lost[0]
    assert [item.get("label") for item in chart.series].count("mean") == 2
    x, high, low, *_, before, after, _, _, _ = chart.data
    seconds = np.unique(x)
    assert np.isnan(before[x >= seconds[lost[0]]]).all() and np.isfinite(before[x < seconds[lost[0]]]).all()
    assert np.isnan(after[x <= seconds[lost[-1]]]).all() and np.isfinite(after[x > seconds[lost[-1]]]).all()
    gap = np.isnan(before) & np.isnan(after)
    assert np.all(high[gap] == low[gap]) and np.all(high[~gap] > low[~gap])
    assert len(chart.series) == len(chart.data)
    engine.submit(SetEstimator("pf"))
    view.frame()
    assert [item.get("label") for item in chart.series].count("mean") == 1
    assert [item.get("label") for item in chart.series].count("previous") == 2
    assert len(chart.series) == len(chart.data)


def test_the_other_charts_end_their_lines_and_pictures_and_begin_them_anew(tmp_path):
    engine = by_hand("ekf", fixes(1, RESET_AT - 1), reset(), fixes(RESET_AT + 1, END))
    feed = RerunFeed(engine)
    data = [message for message in feed.next() if isinstance(message, bytes)]
    feed.close()
    file = tmp_path / "piece.rrd"
    file.write_bytes(data[0])
    cleared, drawn = {}, {}
    for chunk in RrdReader(str(file)).stream():
        if not chunk.is_static and "time" in (batch := chunk.to_record_batch()).schema.names:
            t = batch.column(batch.schema.names.index("time")).cast(pa.int64()).to_numpy()
            into = cleared if "Clear:is_recursive" in batch.schema.names else drawn
            into.setdefault(chunk.entity_path, set()).update((t // SECOND).tolist())
    track, t = engine._fold.track, engine._log.events.t // SECOND
    first = int(t[lost_rows(track)[0]])
    pair = f"/pair/{pair_name(RAIL, engine.pairs[0])}/up"
    paths = ["/state/east", "/state/height", *(f"{pair}/{name}" for name in ("ellipse", "mean", "way", "numbers"))]
    for path in paths:
        assert cleared[path] == {first}
        assert drawn[path] == {*range(1, first), *range(RESET_AT, END + 1)}
    # Events that could not be used have no innovation, and the first had one.
    failed = int(t[np.flatnonzero(track.verdict == 5)[0]])
    assert cleared["/innovation/gnss.east"] == {failed}
    assert "/truth/east" not in cleared and "/reading/gnss.east" not in cleared


def test_it_is_said_since_when_and_what_mends_it():
    engine = by_hand("ekf", fixes(1, 3))
    assert fresh_status(engine).lost is None and status_json(engine)["lost"] is None
    engine._accept([fixes(4, RESET_AT - 1)])
    first = int(engine._log.t[lost_rows(engine._fold.track)[0]])
    status = fresh_status(engine)
    assert status.health == DIVERGED and status.lost == status_json(engine)["lost"] == first
    text = status_html(status, SECOND)
    assert f"not a number since {first / SECOND - 1:.1f} s" in text and "<b>Reset</b>" in text and "filter" in text
    assert "contradict" not in text
    (line,) = [line for line in engine.notices.since(0) if "not a number" in line.text]
    assert (line.t, line.level) == (first, "error") and "Reset" in line.text and "filter" in line.text
    engine._accept([reset()])
    assert fresh_status(engine).lost is None and "not a number" not in status_html(fresh_status(engine), SECOND)
    # Lost again, and a late reading folds all of it anew: it is said of the second time, not of the first.
    engine._accept([events(RAIL, READING, 0, [21.0, 22.0, 23.0], [[11.0, 0.0]] * 3)])
    again = fresh_status(engine).lost
    assert again == 22 * SECOND
    engine._accept([events(RAIL, READING, 0, [22.5], [[11.0, 0.0]])])
    assert fresh_status(engine).lost == again
    engine._accept([events(RAIL, READING, 0, [21.5], [[11.0, 0.0]])])
    assert fresh_status(engine).lost == 21.5 * SECOND


def test_it_is_said_of_the_filter_that_is_shown():
    engine = by_hand("pf", fixes(1, RESET_AT - 1))
    assert fresh_status(engine).lost is None
    swap(engine, "ekf")
    assert fresh_status(engine).lost == int(engine._log.t[lost_rows(engine._fold.track)[0]])
    swap(engine, "pf")
    assert fresh_status(engine).lost is None


def test_counts_are_those_of_the_revision_that_is_shown():
    engine = by_hand("pf", fixes(1, RESET_AT - 1))
    assert fresh_status(engine).counts["recovered"] == engine._fold.recoveries() > 0
    assert (
        f"{engine._fold.recoveries()}</span>"
        in status_html(fresh_status(engine), SECOND).partition("recovered</span>")[2]
    )
    swap(engine, "ekf")
    counts = fresh_status(engine).counts
    assert "recovered" not in counts and "recovered" not in status_html(fresh_status(engine), SECOND)
    assert counts["failed"] == np.count_nonzero(engine._fold.track.verdict == 5) > 0
    swap(engine, "pf")
    assert fresh_status(engine).counts["recovered"] == engine._fold.recoveries()
    assert fresh_status(engine).counts["failed"] == np.count_nonzero(engine._fold.track.verdict == 5)


def test_counts_of_forgotten_rows_are_those_of_the_filter_that_folded_them(monkeypatch):
    """The oldest rows were gated, and are gone: another filter has not seen them."""
    monkeypatch.setattr("app.engine.engine.SPARSE_EVERY", 64)
    monkeypatch.setattr("estimators.snapshots.SPARSE_EVERY", 64)
    made = twin(history=64)
    made.tuning = made.tuning.set("gate", 0.9973)
    engine = Engine(made, lambda report: Scripted())
    t = np.arange(1.0, 1001.0)
    for at in range(0, t.size, 50):
        engine._accept([readings(t[at : at + 50], np.where(t[at : at + 50] % 10 == 5, 1e4, 40.0))])
    assert engine._log.first > 0
    assert fresh_status(engine).counts["readings"] == 1000 and fresh_status(engine).counts["gated"] == 100
    swap(engine, "ukf")
    counts = fresh_status(engine).counts
    assert counts["readings"] == engine._fold.n < 1000
    assert counts["gated"] == np.count_nonzero(engine._fold.track.verdict == 2) > 0


def test_runs_are_drawn_apart_and_the_oldest_together():
    rng = np.random.default_rng(3)
    values = rng.normal(size=200)
    values[rng.random(200) < 0.3] = np.nan
    known = np.isfinite(values)
    for most in (1, 4, 1000):
        columns = runs(values, known, most)
        assert len(columns) <= most
        there = np.isfinite(columns)
        np.testing.assert_array_equal(there.sum(axis=0), known)
        np.testing.assert_array_equal(np.nansum(columns, axis=0)[known], values[known])
        for column in there[1:]:
            index = np.flatnonzero(column)
            assert index.size == index[-1] - index[0] + 1
    assert len(runs(values, known, 1000)) == np.count_nonzero(known & ~np.append(False, known[:-1]))
    (nothing,) = runs(np.full(3, np.nan), np.zeros(3, bool), 4)
    assert np.isnan(nothing).all()
    np.testing.assert_array_equal(extended(np.array([np.nan, 1.0, np.nan, 3.0, np.nan])), [1, 1, 2, 3, 3])


def test_a_field_that_is_not_a_number_is_grey_and_has_no_scale():
    model = MODELS["thermal_field"]
    lost = np.full(model.grid.shape, np.nan)
    scale = Scale(ESTIMATE)
    scale.fit(lost)
    assert scale.ticks() == [] and np.all(scale.indices(lost) == NOTHING)
    stream = rr.RecordingStream("field")
    data = stream.binary_stream()
    FieldDrawing(model, truth=False)._draw(Sink(stream, window=60.0), SECOND, ESTIMATE.name, lost)
    assert b"/field/estimate/image" in data.read()


def test_a_fields_chart_has_a_gap_too():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        spread = np.array([1.0, 1.1, np.nan, np.nan, 0.9, 0.8])
        pictures = [
            Picture(k, k * SECOND, 1, 2 * value, 0.9, value, None, None, None) for k, value in enumerate(spread)
        ]
        chart = FieldChart(server.gui, MODELS["thermal_field"].grid, SECONDS, truth=True)
        history = SimpleNamespace(column=lambda name: np.arange(6) * SECOND, origin=0)
        chart.draw(pictures, history, None, SECONDS)
        x, *lines, _ = chart._chart.data
        expected = np.full((2, 6), np.nan)
        expected[0, :2], expected[1, 4:] = spread[:2], spread[4:]
        np.testing.assert_array_equal(x, np.arange(6.0))
        np.testing.assert_allclose(lines, np.vstack((2 * expected, expected)))
        assert len(chart._chart.series) == 6
    finally:
        server.stop()
