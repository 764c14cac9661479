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
from rerun.chunk import RrdReader

from app.charts.colors import ESTIMATE, UNKNOWN_INDEX, Scale
from app.engine.commands import SetEstimator
from app.engine.engine import Engine
from app.explore.feed import RerunFeed
from app.explore.pictures import FieldDrawing
from app.explore.sink import Sink, pair_name
from app.scene.view import ViserView
from app.web.twin_json import status_json
from config.schema import SceneSection, ViewSection
from estimators.log import READING, RESET
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.track import DIVERGED
from estimators.tuning import Tuning
from tests.app.scripted import Scripted, Stepped, events, fresh_status, readings, twin, viewed
from tests.models import first_states
from tests.support import SECOND

RESET_AT, END = 20, 24


def f(x, u, p, dt, out):
    for k in range(3):
        out[k] = x[k]
    if x[0] > 8.0:
        for k in range(3):
            out[k] = np.nan


RAIL = StateSpaceModel(
    name="rail", title="Rail", f=f,
    states=(State("east", "m", 0, 5), State("north", "m", 0, 1), State("height", "m", 0, 1)),
    noises=(Noise("east", "m²/s", 1.0), Noise("north", "m²/s", 0.1), Noise("height", "m²/s", 0.1)),
    sensors=(Sensor("gnss", (Row("east", "m", 0.25), Row("north", "m", 0.25)), first_states),),
)  # fmt: skip


def f_of_one(x, u, p, dt, out):
    """Only one state has no number: that is no estimate either."""
    for k in range(3):
        out[k] = x[k]
    if x[0] > 8.0:
        out[0] = np.nan


ONE = replace(RAIL, name="rail_of_one", f=f_of_one)


@pytest.fixture(params=[RAIL, ONE], ids=["all states", "one state"])
def rail(request):
    return request.param


def fixes(first, last):
    t = np.arange(first, last + 1.0)
    return events(RAIL, READING, 0, t, np.stack((12.0 - np.abs(t - 12.0), 0 * t), axis=1))


def reset(at=RESET_AT):
    return events(RAIL, RESET, 0, [at], [np.nan])


def by_hand(model, estimator, *batches):
    """An engine without threads that has these measurements."""
    made = twin()
    made.model, made.tuning, made.estimator = model, Tuning.of(model).with_options({}), estimator
    made.config.view = SimpleNamespace(window=60.0)
    stepped = Stepped(of=made).put(*batches)
    return stepped.engine


def swap(engine, estimator):
    engine.retune(estimator, engine.tuning.with_options({}))
    engine.settle()


def lost_rows(track):
    return np.flatnonzero(~np.isfinite(track.mean).all(axis=1))


@pytest.fixture(params=["belief", "vehicle"])
def view(request, rail):
    scene = SceneSection(kind="vehicle", position=("east", "north")) if request.param == "vehicle" else SceneSection()
    engine = viewed(rail, "pf", ViewSection(window=60.0, scene=scene))
    engine.put(fixes(1, RESET_AT - 1))
    view = ViserView(engine, secret="x")
    view.frame()
    yield view
    view.stop()


def shown(scene):
    """Whether what stands for the estimate is seen: its place, its ellipse, its cloud."""
    if hasattr(scene, "_belief"):
        return scene._belief.visible, scene._belief.visible, any(cloud.visible for cloud in scene._clouds)
    return scene._vehicle.visible, scene._ellipse.visible and scene._rim.visible, scene._cloud.visible


def test_the_scene_drops_the_filter_before_and_shows_what_is_there_again(view):
    assert shown(view.renderer.scene) == (True, True, True)
    view.engine.submit(SetEstimator("ekf"))
    assert np.isnan(view.engine.belief().mean).any()
    view.frame()
    assert shown(view.renderer.scene) == (False, False, False)
    view.engine.put(reset())
    view.engine.put(fixes(RESET_AT + 1, END))
    view.frame()
    assert np.isfinite(view.engine.belief().mean).all()
    # A Gaussian filter has no cloud.
    assert shown(view.renderer.scene) == (True, True, False)


def test_the_other_charts_end_their_lines_and_pictures_and_begin_them_anew(rail, tmp_path):
    engine = by_hand(rail, "ekf", fixes(1, RESET_AT - 1), reset(), fixes(RESET_AT + 1, END))
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
    pair = f"/pair/{pair_name(rail, engine.pairs[0])}/up"
    paths = ["/state/east", "/state/height", *(f"{pair}/{name}" for name in ("ellipse", "mean", "way", "numbers"))]
    for path in paths:
        assert cleared[path] == {first}
        assert drawn[path] == {*range(1, first), *range(RESET_AT, END + 1)}
    # Events that could not be used have no innovation, and the first had one.
    failed = int(t[np.flatnonzero(track.verdict == 5)[0]])
    assert cleared["/innovation/gnss.east"] == {failed}
    assert "/truth/east" not in cleared and "/reading/gnss.east" not in cleared


def test_it_is_said_since_when_and_what_mends_it(rail):
    engine = by_hand(rail, "ekf", fixes(1, 3))
    assert fresh_status(engine).lost is None and status_json(engine)["lost"] is None
    engine._accept([fixes(4, RESET_AT - 1)])
    first = int(engine._log.t[lost_rows(engine._fold.track)[0]])
    status = fresh_status(engine)
    assert status.health == DIVERGED and status.lost == status_json(engine)["lost"] == first
    assert "nan" not in str(status_json(engine)).lower()
    (line,) = [line for line in engine.notices.since(0) if "not a number" in line.text]
    assert (line.t, line.level) == (first, "error") and "Reset" in line.text and "filter" in line.text
    engine._accept([reset()])
    assert fresh_status(engine).lost is None
    # Lost again, and a late reading folds all of it anew: it is said of the second time, not of the first.
    engine._accept([events(RAIL, READING, 0, [21.0, 22.0, 23.0], [[11.0, 0.0]] * 3)])
    again = fresh_status(engine).lost
    assert again == 22 * SECOND
    engine._accept([events(RAIL, READING, 0, [22.5], [[11.0, 0.0]])])
    assert fresh_status(engine).lost == again
    engine._accept([events(RAIL, READING, 0, [21.5], [[11.0, 0.0]])])
    assert fresh_status(engine).lost == 21.5 * SECOND


def test_it_is_said_of_the_filter_that_is_shown(rail):
    engine = by_hand(rail, "pf", fixes(1, RESET_AT - 1))
    assert fresh_status(engine).lost is None
    swap(engine, "ekf")
    assert fresh_status(engine).lost == int(engine._log.t[lost_rows(engine._fold.track)[0]])
    swap(engine, "pf")
    assert fresh_status(engine).lost is None


def test_counts_are_those_of_the_revision_that_is_shown(rail):
    engine = by_hand(rail, "pf", fixes(1, RESET_AT - 1))
    assert fresh_status(engine).counts["recovered"] == engine._fold.recoveries() > 0
    swap(engine, "ekf")
    counts = fresh_status(engine).counts
    assert "recovered" not in counts
    assert counts["failed"] == np.count_nonzero(engine._fold.track.verdict == 5) > 0
    swap(engine, "pf")
    assert fresh_status(engine).counts["recovered"] == engine._fold.recoveries()
    assert fresh_status(engine).counts["failed"] == np.count_nonzero(engine._fold.track.verdict == 5)


def test_counts_of_forgotten_rows_are_those_of_the_filter_that_folded_them(monkeypatch):
    """The oldest rows were gated, and are gone: another filter has not seen them."""
    monkeypatch.setattr("app.engine.running_fold.PERMANENT_SPACING", 64)
    monkeypatch.setattr("estimators.snapshots.PERMANENT_SPACING", 64)
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


def test_a_field_that_is_not_a_number_is_grey_and_has_no_scale():
    model = MODELS["thermal_field"]
    lost = np.full(model.grid.shape, np.nan)
    scale = Scale(ESTIMATE)
    scale.fit(lost)
    assert scale.ticks() == [] and np.all(scale.indices(lost) == UNKNOWN_INDEX)
    stream = rr.RecordingStream("field")
    data = stream.binary_stream()
    FieldDrawing(model, truth=False)._draw(Sink(stream, window=60.0), SECOND, ESTIMATE.name, lost)
    assert b"/field/estimate/image" in data.read()
