"""A large field on the page, live and in files: pictures, charts of a few cells, swaps, and the same bits on review."""

from types import SimpleNamespace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from app.charts.colors import (
    ERROR,
    EXTREME_DOT,
    LARGE_DOT,
    NORMAL_DOT,
    UNKNOWN_DOT,
    UNKNOWN_INDEX,
    PictureFrame,
    Scale,
    sensor_colors,
)
from app.charts.direct_readings import observed
from app.cli.run import open_review
from app.engine import commands
from app.engine.engine import Engine
from app.explore.feed import RerunFeed
from app.explore.rows import RerunRows
from app.record.writer import Recorder
from app.scene import field_scenes as field_scene
from app.scene.view import ViserView
from app.twin.twin import load_twin
from estimators.errors import ConfigError
from estimators.log import READING
from estimators.model.parts import Field
from tests.app.scripted import Scripted, pull_all
from tests.cases import cases
from tests.support import as_log, folded
from tests.waiting import wait_for

PLATE = """
title: A small plate
model: ./plate.py:Plate
estimator: {name: ensrf, options: {members: 10, radius: 0.06}}
filters:
  etkf: {members: 8}
source:
  type: simulator
  seed: 2
  step: 1
  duration: 20
  truth: {every: 5}
  faults:
    - {sensor: thermocouples, row: t2_3, kind: bias, size: 40, start: 10}
view:
  cells: ["temperature[2,3]", "temperature[5,5]", "temperature[0,9]"]
  window: 12
  picture: 2
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plate")
    (folder / "plate.py").write_text(
        "from estimators.models.thermal_field import thermal_field\nPlate = thermal_field(8, 12, 2, name='plate')\n"
    )
    (folder / "plate.yaml").write_text(PLATE)
    return folder


@pytest.fixture(scope="module")
def twin(folder):
    return load_twin(folder / "plate.yaml")


@pytest.fixture(scope="module")
def batches(twin):
    source = twin.open_source(lambda key, text: None)
    found = []
    while (batch := source.read(0.0)) is not None:
        # Each second for itself, as a live twin gets them.
        for t in np.unique(batch.t):
            found.append(batch.select(batch.t == t))
    return found


class Running:
    """An engine on the plate's readings, in real threads."""

    def __init__(self, twin, batches):
        self.source = Scripted()
        self.engine = Engine(twin, lambda report: self.source)
        self.recorder = self.engine.recorder = Recorder(
            self.engine, lambda stream: RerunRows(stream, self.engine, series=None)
        )
        self.engine.start()
        self.put(batches)

    def put(self, batches):
        wanted = len(self.pull().events) + sum(map(len, batches))
        for batch in batches:
            self.source.put(batch)
        wait_for(lambda: len(self.pull().events) == wanted)

    def end(self):
        self.source.put(None)
        wait_for(lambda: self.engine.status().finished)

    def pull(self):
        return pull_all(self.engine)

    def submit(self, command):
        revision = self.engine.status().revision
        self.engine.submit(command)
        wait_for(lambda: self.engine.status().revision > revision)


@pytest.fixture
def running(twin, batches):
    made = []

    def run(part=batches):
        made.append(Running(twin, part))
        return made[-1]

    yield run
    for item in made:
        item.engine.stop()
        item.recorder.stop()


def direct(twin, tuning, estimator, readings):
    log = as_log(readings)
    return folded(estimator, twin.model, log, tuning, pairs=twin.pairs, picture=twin.picture)


def assert_same_pictures(ours, theirs):
    assert [picture.before for picture in ours] == [picture.before for picture in theirs]
    for a, b in zip(ours, theirs, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)


def entities(data, tmp_path):
    """{entity: [(t, columns)]} of Rerun's bytes or of a file."""
    path = data
    if not hasattr(data, "exists"):
        path = tmp_path / "piece.rrd"
        path.write_bytes(b"".join(piece for piece in data if isinstance(piece, bytes)))
    found = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        names = batch.schema.names
        for row in range(batch.num_rows):
            t = batch.column(names.index("time"))[row].value if "time" in names else None
            found.setdefault(chunk.entity_path, []).append(
                (t, {name: batch.column(k)[row] for k, name in enumerate(names)})
            )
    return found


def bytes_of(columns):
    (name,) = [name for name in columns if name.endswith(":buffer")]
    return bytes(columns[name][0].as_py())


def timed(rows):
    return [(t, columns) for t, columns in rows if t is not None]


def seconds(picture):
    return picture.t // 10**9


def test_a_swap_and_a_retune_leave_tracks_and_pictures_complete(running, twin, batches):
    live = running(batches[:-4])
    for command in (
        commands.SetEstimator("etkf"),
        commands.SetOption("inflation", 1.1),
        commands.SetTuning("R.thermocouples", 0.5),
        commands.SetEstimator("ensrf"),
        commands.SetOption("radius", 0.03),
    ):
        live.submit(command)
        pull, (tuning, estimator) = live.pull(), live.engine.folded_with()
        expected = direct(twin, tuning, estimator, pull.events)
        np.testing.assert_array_equal(pull.track.mean, expected.track.mean)
        assert_same_pictures(pull.pictures, expected.pictures.taken)
        assert len(pull.pictures) > 6
    assert (tuning.r == 0.5).all() and tuning.options["radius"] == 0.03
    # And it goes on.
    live.put(batches[-4:])
    live.end()
    pull = live.pull()
    expected = direct(twin, tuning, estimator, pull.events)
    expected.finish()
    assert_same_pictures(pull.pictures, expected.pictures.taken)
    assert seconds(pull.pictures[-1]) == 20 and pull.pictures[-1].cells == 96


def test_a_cursor_gets_each_picture_once(running, batches):
    live = running(batches[:9])
    cursor = live.engine.cursor()
    got = [live.engine.pull(cursor).pictures]
    assert live.engine.pull(cursor).pictures == []
    for k in range(9, len(batches)):
        live.put(batches[k : k + 1])
        got.append(live.engine.pull(cursor).pictures)
    assert_same_pictures([picture for part in got for picture in part], live.pull().pictures)
    # In pieces too.
    pieces, cursor = [], live.engine.cursor()
    while (pull := live.engine.pull(cursor, 7)).events.t.size:
        pieces += pull.pictures
    assert_same_pictures(pieces, live.pull().pictures)


def test_a_recording_reviews_to_the_same_pictures(running, twin, batches, tmp_path):
    live = running()
    live.end()
    path = tmp_path / "plate.rrd"
    live.engine.submit(commands.Record(path))
    wait_for(lambda: live.engine.status().recording is not None)
    live.engine.submit(commands.Record(None))
    wait_for(lambda: live.recorder.finished)
    seen = live.pull()
    session, _ = open_review(path, None)
    try:
        session.start()
        wait_for(lambda: session.engine.status().finished)
        cursor = session.engine.cursor()
        again = session.engine.pull(cursor)
    finally:
        session.stop()
    np.testing.assert_array_equal(again.track.mean, seen.track.mean)
    assert_same_pictures(again.pictures, seen.pictures)

    # What Rerun draws of them: every picture, with the colours of its values.
    drawn = entities(path, tmp_path)
    rows = timed(drawn["/field/estimate/image"])
    assert [t // 10**9 for t, _ in rows] == [seconds(picture) for picture in seen.pictures]
    told = [picture for picture in seen.pictures if picture.truth is not None]
    assert (
        [t // 10**9 for t, _ in timed(drawn["/field/error/image"])]
        == [seconds(picture) for picture in told]
        == [5, 10, 15, 20]
    )
    frame = PictureFrame.of(twin.model.grid)
    picture = np.frombuffer(bytes_of(rows[-1][1]), np.uint8).reshape(frame.height, frame.width)
    index = picture[frame.tall // 2 :: frame.tall, frame.wide // 2 :: frame.wide].astype(int)
    mean = seen.pictures[-1].mean
    # Warmer is a later colour; a line through both, as the scale is linear.
    slope, start = np.polyfit(mean.ravel(), index.ravel(), 1)
    assert slope > 0
    np.testing.assert_allclose(start + slope * mean, index, atol=1.5)
    rmse = [columns["Scalars:scalars"][0].as_py() for t, columns in drawn["/field/rmse"] if t is not None]
    np.testing.assert_allclose(rmse, [picture.rmse for picture in told])
    assert not any(path.startswith("/innovation/thermocouples.") for path in drawn)
    assert sum(t is not None for t, _ in drawn["/innovation/thermocouples"]) == 20
    states = sorted(path.replace("\\", "") for path in drawn if path.startswith("/state/"))
    assert states == ["/state/temperature[0,9]", "/state/temperature[2,3]", "/state/temperature[5,5]"]


def test_a_new_revision_reaches_the_viewer_with_all_its_pictures(running, tmp_path):
    live = running()
    feed = RerunFeed(live.engine)
    feed.next()
    live.submit(commands.SetOption("inflation", 1.2))
    first = entities(feed.next(), tmp_path)
    rest = entities(feed.next(), tmp_path)
    feed.close()
    expected = [seconds(picture) for picture in live.pull().pictures]
    times = [[t // 10**9 for t, _ in timed(part.get("/field/std/image", []))] for part in (first, rest)]
    assert times[1] + times[0] == expected and times[0] and times[1]


def test_the_scene_shows_the_picture_that_is_chosen_and_the_sensor_that_is_off(running, monkeypatch):
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(field_scene.time, "monotonic", lambda: clock.now)
    live = running()
    view = ViserView(live.engine, secret="s")
    try:
        view.frame()
        scene, pull = view.renderer.scene, live.pull()
        assert scene._title.text == "temperature: estimate [°C]"
        frame = PictureFrame.of(live.engine.model.grid)
        first = scene._image.image.copy()
        assert first.shape == (frame.height, frame.width, 3)
        # Hottest where the estimate is hottest.
        mean = pull.pictures[-1].mean
        i, j = np.unravel_index(mean.argmax(), mean.shape)
        shown = first[:: frame.tall, :: frame.wide].astype(int).sum(axis=2)
        assert shown[i, j] == shown.max()
        # Red are the sensors that are far off in the newest reading: the one with a bias of 40 °C, not all.
        last = np.flatnonzero(pull.events.kind == READING)[-1]
        far = np.abs(pull.track.innovation[last] / pull.track.innovation_std[last]) >= 3
        biased = [row.name for row in live.engine.model.sensors[0].rows].index("t2_3")
        assert far[biased] and not far.all()
        np.testing.assert_array_equal((scene._points.colors == EXTREME_DOT).all(axis=1), far)

        # Another picture, but not sooner than may be.
        scene._dirty = True
        monkeypatch.setattr(type(scene._image), "image", property(lambda self: None, lambda self, value: pytest.fail()))
        view.frame()
        monkeypatch.undo()
        monkeypatch.setattr(field_scene.time, "monotonic", lambda: clock.now)
        clock.now += field_scene.PICTURE_PERIOD_S
        view.renderer.choices.choose("picture", ERROR.title)
        view.frame()
        assert scene._title.text == "temperature: estimate − truth [°C]"
        assert not np.array_equal(scene._image.image, first)
    finally:
        view.stop()


def test_only_charted_cells_are_looked_for_among_what_sensors_read(twin):
    (found,) = observed(twin.model)
    assert twin.model.state_names[found.state] == "temperature[2,3]"
    assert twin.model.sensors[0].rows[found.row].name == "t2_3"


@cases(__file__, "refused_views.csv")
def test_a_view_that_cannot_be_is_refused(folder, old, new, error):
    path = folder / "plate.yaml"
    path.write_text(PLATE.replace(old, new))
    try:
        with pytest.raises(ConfigError, match=error):
            load_twin(path)
    finally:
        path.write_text(PLATE)


def test_cells_are_for_large_fields_only(tmp_path):
    (tmp_path / "w.yaml").write_text(
        "model: motor_winding\nsource: {type: simulator, duration: 5}\nestimator: kf\nview: {cells: [temperature]}\n"
    )
    with pytest.raises(ConfigError, match="view.cells is for large fields; every state of motor_winding is kept"):
        load_twin(tmp_path / "w.yaml")


# Colours and scales


def test_a_scale_has_round_numbers_and_moves_seldom():
    scale = Scale(ERROR)
    scale.fit(np.array([-0.7, 0.2, np.nan]))
    assert scale.low == -scale.high and scale.high >= 0.69
    assert [text for _, text in scale.ticks()] == ["-0.5", "0.0", "0.5"]
    before = (scale.low, scale.high)
    scale.fit(np.array([-0.5, 0.5]))
    assert (scale.low, scale.high) == before
    scale.fit(np.array([-2.0, 1.0]))
    assert scale.high >= 1.99
    scale.fit(np.array([0.0, 0.1]))
    assert scale.high < 0.3
    assert scale.indices(np.array([[0.0, np.nan, 9.0, -9.0]])).tolist() == [[127, UNKNOWN_INDEX, UNKNOWN_INDEX - 1, 0]]
    assert [place for place, _ in scale.ticks()][0] >= 0


def test_a_frame_keeps_distances_in_shape():
    """Cells of 27.8 km by 16.3 km; places in the middle of their cells."""
    frame = PictureFrame.of(Field("t", "K", (33, 49), spacing=(27.8, 16.3)))
    assert frame.tall / frame.wide == pytest.approx(27.8 / 16.3, rel=0.05)
    np.testing.assert_allclose(
        frame.pixels(np.array([[27.8, 16.3 * 48]])), [[48.5 * frame.wide, 1.5 * frame.tall]], rtol=1e-12
    )
    large = PictureFrame.of(Field("t", "K", (1000, 1000), spacing=0.01))
    assert (large.rows, large.columns, large.reduced) == (200, 200, 5)
    np.testing.assert_allclose(large.pixels(np.array([[9.99, 0.0]])) / large.wide, [[0.1, 199.9]])


def test_sensors_are_coloured_by_their_innovation():
    colors = sensor_colors(np.array([-1.9, 2.1, -3.2, np.nan]))
    assert [tuple(color) for color in colors] == [NORMAL_DOT, LARGE_DOT, EXTREME_DOT, UNKNOWN_DOT]
