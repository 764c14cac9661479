"""What one browser's Rerun viewer is fed, read back with Rerun's own reader."""

import json
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader

from app.engine import commands, history_copy
from app.explore import feed
from app.explore.feed import FIRST_WINDOWS, RerunFeed
from app.explore.layout import blueprint
from app.explore.pictures import LABEL_HALF_WIDTH, LABEL_HEIGHT, PICTURE_RATIO, anchors, axis_scales, ellipse_points
from app.explore.rows import RerunRows
from app.explore.sink import last_of_each_time, pair_name, thin
from app.format_time import FIRST_DATED_NS
from app.record.reader import read_recording
from app.record.writer import Recorder
from estimators.diagnostics.detectors import ADVISORY_ALARM
from estimators.diagnostics.references import HALF_WIDTH
from estimators.log import READING, TRUTH, Events
from estimators.track import HEALTH_NAMES
from tests.app.scripted import MODEL, Replayed, Stepped, pull_all, readings, twin
from tests.support import SECOND
from tests.waiting import wait_for

WINDOW = 10.0


class Fed(Stepped):
    """An engine on readings that the test gives, and a feed of it."""

    def __init__(self, tmp_path, **options):
        made = twin(**options)
        made.config.view = SimpleNamespace(window=WINDOW)
        super().__init__(source=Replayed(), of=made)
        self.feed = RerunFeed(self.engine)
        self.file = tmp_path / "piece.rrd"
        self.said = []
        self.pieces = []

    def events(self):
        return len(self.track().events)

    def track(self):
        return pull_all(self.engine)

    def next(self):
        messages = self.feed.next()
        for message in messages:
            if isinstance(message, bytes):
                self.pieces.append(message)
            else:
                self.said.append(json.loads(message))
                self.pieces = []
        return messages

    def show(self, *batches):
        """Fold measurements, and take what the viewer is fed then."""
        self.put(*batches)
        self.next()

    def retune(self):
        """Begin another revision, and take what the viewer is fed of it."""
        self.submit(commands.SetTuning("Q.temperature", 5.0))
        self.next()

    def chunks(self, which=slice(None)):
        for piece in self.pieces[which]:
            self.file.write_bytes(piece)
            yield from RrdReader(str(self.file)).stream()

    def column(self, path, component="Scalars:scalars", which=slice(None)):
        """Times in ns and values under a path of the present recording, in order of time."""
        times, values = [np.zeros(0, np.int64)], []
        for chunk in self.chunks(which):
            if chunk.entity_path != path or chunk.is_static:
                continue
            batch = chunk.to_record_batch()
            if "Clear:is_recursive" in batch.schema.names:
                continue
            t = batch.column(batch.schema.names.index("time")).cast(pa.int64()).to_numpy()
            times.append(t)
            flat = batch.column(batch.schema.names.index(component)).flatten().to_numpy(zero_copy_only=False)
            values.append(flat.reshape(t.size, -1))
        t = np.concatenate(times)
        order = np.argsort(t, kind="stable")
        return t[order], np.concatenate(values)[order] if values else np.zeros((0, 1))

    def lines(self):
        """Times in ns and texts of the events, but for those of the health, which a thread of the engine says."""
        times, texts = self.column("/events", "TextLog:text")
        told = zip(times.tolist(), texts.ravel().tolist(), strict=True)
        return [(t, text) for t, text in told if "health: " not in text]


@pytest.fixture
def fed(tmp_path):
    fed = Fed(tmp_path)
    yield fed
    fed.feed.close()
    fed.engine.stop()


def truths(times_s, values):
    """Blocks of true states from the first one on, or single values of it."""
    values = np.asarray(values, float).reshape(len(times_s), -1)
    batch = readings(times_s, values[:, 0])
    return Events(batch.t, batch.arrival, np.full(len(batch), TRUTH, np.int8), batch.channel, values)


def test_bytes_hold_the_rows_of_the_track(fed):
    t = np.arange(1, 31) * 0.25
    block = np.stack((40 + np.cos(t), np.where(np.arange(30) % 3, np.sin(t), np.nan)), axis=1)
    batch = Events.concat([readings(t, 40 + np.sin(t)), truths(t, block)], fed.engine.model.width)
    fed.show(batch.select(np.argsort(batch.t, kind="stable")))
    pull = fed.track()
    rows = last_of_each_time(pull.events.t)
    for j, name in enumerate(fed.engine.model.state_names):
        times, values = fed.column(f"/state/{name}")
        np.testing.assert_array_equal(times, pull.events.t[rows])
        mean, std = pull.track.mean[rows, j], pull.track.std[rows, j]
        np.testing.assert_array_equal(values, np.stack((mean, mean + 2 * std, mean - 2 * std), axis=1))
    reading = pull.events.kind == READING
    sensor = fed.engine.model.row_names[0]
    np.testing.assert_array_equal(fed.column(f"/reading/{sensor}")[1], pull.events.value[reading, :1])
    np.testing.assert_array_equal(fed.column("/nis/reading")[1][:, 0], pull.track.nis[reading])
    _, values = fed.column(f"/innovation/{sensor}")
    np.testing.assert_array_equal(values[:, 0], pull.track.innovation[reading, 0])
    np.testing.assert_array_equal(values[:, 1], 2 * pull.track.innovation_std[reading, 0])
    np.testing.assert_array_equal(fed.column("/truth/temperature")[1][:, 0], block[:, 0])
    np.testing.assert_array_equal(fed.column("/truth/rate")[1][:, 0], block[np.arange(30) % 3 > 0, 1])
    both = np.isfinite(block).all(axis=1)
    times, values = fed.column(f"/pair/{pair_name(fed.engine.model, [0, 1])}/up/truth", "Points2D:positions")
    assert set(times.tolist()) == set(np.round(t[both] * 1e9).astype(int).tolist())
    at = np.searchsorted(np.round(t * 1e9).astype(int), times)
    points = np.stack([np.concatenate(row) for row in values])
    np.testing.assert_allclose(points, block[at] / axis_scales(fed.engine.model, np.array([0, 1])), rtol=1e-6)
    _, values = fed.column("/nis/window")
    assert np.all((values[:, 1] < values[:, 2])[1:])
    health = pull.track.health
    changes = np.flatnonzero(np.append(-1, health[:-1]) != health)
    times, states = fed.column("/health", "StateChange:state")
    assert states.ravel().tolist() == [HEALTH_NAMES[code] for code in health[changes]]
    np.testing.assert_array_equal(times, pull.events.t[changes])
    words = [
        "advisory" if mask[0] & ADVISORY_ALARM else "suspect" if mask[0] else "tracking"
        for mask in pull.track.alarms[reading]
    ]
    changes = [word for word, before in zip(words, [None, *words], strict=False) if word != before]
    assert fed.column(f"/sensor/{sensor}", "StateChange:state")[1].ravel().tolist() == changes


@pytest.mark.parametrize("wide", [100.0, 4.0, 0.04])
def test_the_numbers_stand_inside_the_picture_and_at_the_mean_where_they_fit(wide):
    # A way `wide` by 4, seen by a pane whose one scale is that of its fuller side.
    way = np.array([[0.0, 0.0], [wide, 4.0], [wide, 0.0]])
    height = max(4.0, wide / PICTURE_RATIO)
    view = np.array([PICTURE_RATIO * height, height])
    middle = np.array([0.5 * wide, 2.0])
    means = np.array([[0.0, 4.0], [wide, 0.0], [0.0, 0.0], middle + [0.0, 0.05 * height]])
    ellipses = ellipse_points(means, np.full((4, 2), 1e-12), np.zeros(4))
    stand = anchors(means, ellipses, [way] * 4)
    share = (stand - middle) / view + 0.5  # from the lower left corner
    assert np.all((share[:, 0] >= LABEL_HALF_WIDTH - 1e-6) & (share[:, 0] <= 1.0 - LABEL_HALF_WIDTH + 1e-6))
    assert np.all(share[:, 1] >= LABEL_HEIGHT - 1e-6)
    np.testing.assert_allclose(stand[3], means[3], rtol=1e-12)
    # No farther from the mean than it must be: along each axis at the mean, or at the limit.
    limits = (
        middle
        + (np.array([[LABEL_HALF_WIDTH, LABEL_HEIGHT], [1.0 - LABEL_HALF_WIDTH, LABEL_HEIGHT]])[:, None] - 0.5) * view
    )
    at_limit = np.isclose(stand, limits[0], atol=1e-5) | np.isclose(stand, limits[1], atol=1e-5)
    assert np.all(np.isclose(stand, means) | at_limit)


def test_nothing_new_is_no_message_and_new_rows_are_sent_once(fed):
    fed.show(readings([1.0, 2.0], [40.0, 41.0]))
    assert fed.next() == []
    fed.show(readings([3.0], [42.0]))
    assert fed.next() == []
    assert fed.column("/state/temperature")[0].tolist() == [1_000_000_000, 2_000_000_000, 3_000_000_000]
    # One count a message, by which the page sees how far the viewer has got.
    counts = [
        int(batch.column(batch.schema.names.index("frame"))[0].as_py())
        for batch in (chunk.to_record_batch() for chunk in fed.chunks() if chunk.entity_path == "/frame")
    ]
    assert counts == [1, 2]


def test_a_new_revision_is_another_recording_with_the_old_one_in_grey(fed):
    t = np.arange(1, 21) * 0.5
    fed.show(readings(t, 40 + t))
    _, old = fed.column("/state/temperature")
    _, old_nis = fed.column("/nis/window")
    fed.retune()
    assert [said["revision"] for said in fed.said] == [0, 1]
    assert fed.said[0]["recording"] != fed.said[1]["recording"]
    _, new = fed.column("/state/temperature")
    np.testing.assert_array_equal(new[:, 0], fed.track().track.mean[:, 0])
    assert np.abs(new[:, 0] - old[:, 0]).max() > 0.1
    np.testing.assert_array_equal(fed.column("/previous/state/temperature")[1][:, 0], old[:, 0])
    np.testing.assert_array_equal(fed.column("/previous/nis")[1][:, 0], old_nis[:, 0])


def test_the_window_of_a_revision_comes_before_its_past(fed):
    t = np.arange(1, 401) * 0.1
    fed.show(readings(t, 40 + np.sin(t)))
    fed.retune()
    times, _ = fed.column("/state/temperature")
    assert times[0] >= (t[-1] - FIRST_WINDOWS * WINDOW) * 1e9 and times[-1] == round(t[-1] * 1e9)
    assert len(fed.pieces) == 1
    fed.next()
    times, values = fed.column("/state/temperature")
    np.testing.assert_array_equal(times, fed.track().events.t)
    np.testing.assert_array_equal(values[:, 0], fed.track().track.mean[:, 0])
    np.testing.assert_array_equal(fed.column("/previous/state/temperature")[0], times)
    assert fed.next() == []


def test_events_outlive_the_recording_and_say_of_which_revision_they_are(fed):
    fed.put(readings([1.0, 2.0], [40.0, 41.0]))
    fed.engine.notices.say("something happened")
    fed.next()
    fed.retune()
    fed.engine.notices.say("something else happened")
    fed.next()
    texts = fed.column("/events", "TextLog:text")[1].ravel().tolist()
    assert "revision 0: something happened" in texts and "something else happened" in texts


def test_the_layout_comes_once(fed):
    def stores(piece):
        return piece.count(b"Blueprint") + piece.count(b"blueprint")

    fed.show(readings([1.0, 2.0], [40.0, 41.0]))
    assert stores(fed.pieces[0]) > 0
    fed.retune()
    # Else the zoom and the play state that the user chose would be lost.
    assert stores(fed.pieces[0]) == 0


def test_late_readings_are_drawn_once_and_lines_do_not_go_back(fed):
    fed.show(readings([1.0, 2.0, 3.0], [40.0, 41.0, 42.0]))
    fed.show(readings([2.5], [41.5]))
    fed.show(readings([4.0], [43.0]))
    sensor = fed.engine.model.row_names[0]
    times, values = fed.column(f"/reading/{sensor}")
    assert (times * 1e-9).tolist() == [1.0, 2.0, 2.5, 3.0, 4.0]
    assert values[:, 0].tolist() == [40.0, 41.0, 41.5, 42.0, 43.0]
    assert (fed.column("/state/temperature")[0] * 1e-9).tolist() == [1.0, 2.0, 3.0, 4.0]


def test_a_reset_at_the_time_of_the_last_reading_is_seen_in_the_picture(fed):
    """As after the end of a source: no event follows that would bring the next picture."""
    fed.show(readings(np.arange(1.0, 21.0), np.full(20, 40.0)))
    fed.submit(commands.Reset())
    assert fed.events() == 21
    fed.next()
    model, pair = fed.engine.model, np.array([0, 1])
    _, values = fed.column(f"/pair/{pair_name(model, pair)}/up/mean", "Points2D:positions")
    prior = [state.mean for state in model.states] / axis_scales(model, pair)
    np.testing.assert_allclose(np.concatenate(values[-1]), prior, rtol=1e-6)


def test_a_withheld_estimate_is_neither_drawn_in_lines_nor_in_pictures(tmp_path):
    """Until its band is narrow enough."""
    limit = 0.5
    first, second = MODEL.states
    fed = Fed(tmp_path, model=replace(MODEL, states=(first, replace(second, withhold=limit))))
    t = np.arange(1.0, 21.0)
    fed.show(readings(t, 40.0 + 0.1 * t))
    track = fed.track().track
    shown = HALF_WIDTH * track.std[:, 1] <= limit
    assert 0 < shown.sum() < t.size
    assert (fed.column("/state/rate")[0] // SECOND).tolist() == t[shown].tolist()
    assert (fed.column("/state/temperature")[0] // SECOND).tolist() == t.tolist()
    drawn, _ = fed.column(f"/pair/{pair_name(MODEL, [0, 1])}/up/mean", "Points2D:positions")
    assert drawn.size and set((drawn // SECOND).tolist()) <= set(t[shown].tolist())
    fed.feed.close()
    fed.engine.stop()


def test_dates_are_dates_and_seconds_are_durations(fed):
    batch = readings(np.array([1.0, 2.0]) + FIRST_DATED_NS * 1e-9, [40.0, 41.0])
    fed.show(batch)
    kinds = {
        batch.schema.field("time").type
        for batch in (
            chunk.to_record_batch()
            for chunk in fed.chunks()
            if chunk.entity_path == "/state/temperature" and not chunk.is_static
        )
    }
    assert kinds and all(pa.types.is_timestamp(kind) for kind in kinds)
    np.testing.assert_array_equal(fed.column("/state/temperature")[0], batch.t)


def test_rows_rewritten_between_two_pieces_count_once(fed, monkeypatch):
    monkeypatch.setattr(feed, "MAX_PULL_ROWS", 10)
    monkeypatch.setattr(history_copy, "MAX_PULL_ROWS", 10)
    t = np.arange(1, 31) * 0.1
    fed.put(readings(t, 40 + t))
    pull = fed.engine.pull
    late = iter([readings([1.55], [99.0])])

    def pull_and_be_late(cursor, limit=None, **named):
        answer = pull(cursor, limit, **named)
        for batch in late if answer.first == 10 else ():
            fed.put(batch)
        return answer

    monkeypatch.setattr(fed.engine, "pull", pull_and_be_late)
    fed.next()
    monkeypatch.undo()
    expected = fed.track()
    assert len(expected.events) == 31
    times, values = fed.column("/state/temperature")
    np.testing.assert_array_equal(times, expected.events.t)
    np.testing.assert_array_equal(values[:, 0], expected.track.mean[:, 0])


def test_a_long_history_is_drawn_by_its_extremes(fed):
    rng = np.random.default_rng(0)
    t = np.arange(1, 30_001) * 0.01
    value = 40 + rng.normal(size=t.size)
    value[12_345] = 500.0
    fed.show(readings(t, value))
    times, values = fed.column(f"/reading/{fed.engine.model.row_names[0]}")
    assert values.max() == 500.0
    assert times.size <= 2 * (feed.HISTORY_STRETCHES + 2)
    assert sum(map(len, fed.pieces)) < 3_000_000


def test_thin_keeps_the_extremes_of_every_stretch():
    rng = np.random.default_rng(1)
    t = np.sort(rng.integers(0, 10_000, 5000))
    low = rng.normal(size=t.size)
    high = low + rng.uniform(0, 1, t.size)
    rows = thin(t, low, high, 100)
    assert np.all(np.diff(rows) > 0) and rows[-1] == t.size - 1
    for stretch in np.unique(t // 100):
        of = np.flatnonzero(t // 100 == stretch)
        kept = np.intersect1d(of, rows)
        assert low[kept].min() == low[of].min() and high[kept].max() == high[of].max()
        assert kept.size <= 2 + (stretch == t[-1] // 100)


def test_ellipses_are_two_sigma():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(20, 2, 2))
    P = root @ root.transpose(0, 2, 1)
    mean = rng.normal(size=(20, 2))
    off = ellipse_points(mean, np.diagonal(P, axis1=1, axis2=2), P[:, 0, 1]) - mean[:, None]
    distance = np.einsum("nki,nij,nkj->nk", off, np.linalg.inv(P), off)
    # The inverse of a covariance near the singular loses digits.
    np.testing.assert_allclose(distance, 4.0, rtol=1e-6)


def test_closing_gives_the_cursor_back(fed):
    other = RerunFeed(fed.engine)
    count = len(fed.engine._cursors)
    other.close()
    assert len(fed.engine._cursors) == count - 1


def test_a_revision_that_begins_between_two_pieces_wins(fed, monkeypatch):
    fed.put(readings(np.arange(1, 21) * 0.1, 40 + np.arange(20.0)))
    pull = fed.engine.pull
    monkeypatch.setattr(feed, "MAX_PULL_ROWS", 10)
    monkeypatch.setattr(history_copy, "MAX_PULL_ROWS", 10)
    seen = []

    def pull_and_retune(cursor, limit=None, **named):
        answer = pull(cursor, limit, **named)
        seen.append(answer.revision)
        if len(seen) == 1:
            fed.submit(commands.SetTuning("Q.temperature", 5.0))
        return answer

    monkeypatch.setattr(fed.engine, "pull", pull_and_retune)
    fed.next()
    monkeypatch.undo()
    assert fed.said[-1]["revision"] == 1
    np.testing.assert_array_equal(fed.column("/state/temperature")[1][:, 0], fed.track().track.mean[:, 0])
    assert fed.track().revision == 1


# After a seek, and in a recording


def seek_back(fed, batch):
    """The source begins again, and gives a batch."""
    revision, read = fed.engine.status().revision, fed.source.read

    def begun_again(timeout):
        fed.source.read = read
        fed.source.restarts = 1
        return batch

    fed.source.read = begun_again
    fed.engine.settle()
    assert pull_all(fed.engine).revision > revision and fed.events() == len(batch)


def newest_of(fed, timeline="time"):
    """The last time at which anything is, ns: where a viewer that follows goes."""
    times = []
    for chunk in fed.chunks():
        batch = chunk.to_record_batch()
        if not chunk.is_static and timeline in batch.schema.names:
            times.append(int(batch.column(batch.schema.names.index(timeline)).cast(pa.int64()).to_numpy().max()))
    return max(times)


def test_after_seeking_back_nothing_lies_beyond_the_rows(fed):
    fed.put(readings(np.arange(1.0, 41.0), np.full(40, 40.0)))
    fed.engine.notices.say("said at 40 s")
    fed.next()
    assert newest_of(fed) == 40 * 10**9
    seek_back(fed, readings(np.arange(1.0, 6.0), np.full(5, 40.0)))
    fed.next()
    assert newest_of(fed) == 5 * 10**9
    # Nor later: it was said of another pass over the recording.
    fed.engine.notices.say("said at 5 s")
    fed.show(readings(np.arange(6.0, 51.0), np.full(45, 40.0)))
    assert newest_of(fed) == 50 * 10**9
    assert fed.lines() == [(5 * 10**9, "said at 5 s")]


def test_a_revision_without_rows_does_not_empty_the_pane(fed):
    fed.show(readings([1.0, 2.0], [40.0, 41.0]))
    seek_back(fed, Events.empty(fed.engine.model.width))
    assert fed.next() == [] and fed.next() == []
    fed.engine.notices.say("still said")
    assert fed.next() == []
    fed.show(readings([1.0], [40.0]))
    assert [said["revision"] for said in fed.said] == [0, 1]
    assert fed.column("/state/temperature")[0].tolist() == [10**9]
    assert [text for _, text in fed.lines()] == ["still said"]


def test_a_line_that_comes_before_its_row_waits_for_it(fed):
    fed.put(readings([1.0, 2.0], [40.0, 41.0]))
    fed.engine.notices.say("ahead", t=3 * 10**9)
    fed.next()
    assert newest_of(fed) == 2 * 10**9
    fed.show(readings([3.0], [40.0]))
    assert [text for _, text in fed.lines()] == ["ahead"]


def test_a_line_is_not_lost_while_there_are_no_rows(fed):
    fed.engine.notices.say("the bus is silent")
    fed.next()
    fed.show(readings([1.0], [40.0]))
    assert [text for _, text in fed.lines()] == ["the bus is silent"]


def test_a_recording_shows_its_events_whatever_was_turned_since(fed, tmp_path):
    """In the stock viewer: the events' view of the last blueprint is where the lines are."""
    path = tmp_path / "retuned.rrd"
    recorder = Recorder(fed.engine, lambda stream: RerunRows(stream, fed.engine, series=None))
    fed.engine.recorder = recorder
    fed.submit(commands.Record(path))
    fed.put(readings([1.0, 2.0], [40.0, 41.0]))
    fed.engine.notices.say("before")
    fed.submit(commands.SetTuning("Q.rate", 3.0))
    fed.put(readings([3.0], [40.0]))
    fed.submit(commands.Record(None))
    wait_for(lambda: path in recorder.finished)
    recorder.stop()
    chunks = list(RrdReader(str(path)).stream())
    lines = {chunk.entity_path for chunk in chunks if "TextLog:text" in chunk.to_record_batch().schema.names}
    assert lines == {"/events"}
    shown = blueprint(fed.engine.model, fed.engine.pairs, window=WINDOW, root="/revision_1")
    views = {view.name: view.origin for view in all_views(shown.root_container)}
    assert views["events"] == "/events" and views["health and sensors"] == "/revision_1/"


def all_views(container):
    for item in container.contents:
        yield from all_views(item) if hasattr(item, "contents") and hasattr(item, "kind") else [item]


def test_closed_streams_end_their_threads_while_another_goes_on_unharmed(tmp_path):
    """A feed a revision and thirty recordings leave no thread, and a recording beside them misses no row."""
    fed = Fed(tmp_path)
    other, recorder = (Recorder(fed.engine, lambda stream: RerunRows(stream, fed.engine, series=None)) for _ in "ab")
    try:
        fed.put(readings(np.arange(1, 51) * 0.1, np.full(50, 40.0)))
        fed.next()
        other.record(tmp_path / "long.rrd")
        wait_for(lambda: other.writing is not None)
        before = threads()
        for k in range(30):
            recorder.record(tmp_path / f"{k}.rrd")
            recorder.record(None)
            fed.submit(commands.SetTuning("Q.rate", 0.01 * (k + 1)))
            fed.put(readings(5.1 + np.arange(20 * k, 20 * k + 20) * 0.1, np.full(20, 40.0)))
            fed.next()
            with_layout = RerunFeed(fed.engine)
            assert with_layout.next()
            with_layout.close()
        wait_for(lambda: len(recorder.finished) == 30)
        wait_for(lambda: threads() <= before + 1)  # the recorder's own
        last = fed.track().events
        other.record(None)
        wait_for(lambda: other.finished)
    finally:
        fed.feed.close()
        fed.engine.stop()
        other.stop()
        recorder.stop()
    assert not other.failure and not recorder.failure
    recorded = read_recording(tmp_path / "long.rrd")
    assert recorded.closed and len(last) == 50 + 30 * 20
    np.testing.assert_array_equal(recorded.events.t, last.t)
    np.testing.assert_array_equal(recorded.events.value, last.value)
    assert all(read_recording(path).closed for path in recorder.finished)


def threads():
    """Threads of this process, those of compiled libraries too."""
    return len(os.listdir("/proc/self/task"))
