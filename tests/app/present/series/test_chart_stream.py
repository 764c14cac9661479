"""What a browser has after many small frames is what it would have been given at once."""

import json
import struct
from typing import Any

import numpy as np
import pytest

from app.live.commands import SetTuning
from app.live.outputs import Pull
from app.present.series.chart_stream import ChartQuery, ChartStream, drawn
from app.present.series.levels_of_detail import grouped
from app.present.series.series import Series
from estimators.log import READING, TRUTH, Events
from estimators.models import MODELS
from tests.app.fake_engine import FakeEngine
from tests.support import SECOND

MODEL = MODELS["motor_winding"]
MEAN, ROW = f"mean:{MODEL.states[0].name}", MODEL.row_names[0]


class Browser:
    """Takes frames as the page does (app/web/page/stream.js)."""

    def __init__(self) -> None:
        self.x: list[float] = []
        self.values: dict[str, list[float]] = {}
        self.bytes = 0

    def take(self, frame: bytes) -> None:
        self.bytes += len(frame)
        length = struct.unpack_from("<I", frame)[0]
        head: dict[str, Any] = json.loads(frame[4 : 4 + length])
        n, at = head["points"], 4 + length
        seconds = np.frombuffer(frame, "<f8", n, at)
        if head["fresh"]:
            self.names, self.x, self.values = head["columns"], [], {name: [] for name in head["columns"]}
            self.first, self.each = head["start"], head["each"]
        if head["offsets"] is not None:
            self.offsets = head["offsets"]
        block = np.frombuffer(frame, "<f4", n * len(self.names), at + 8 * n).reshape(len(self.names), n)
        keep = max(0, min(len(self.x), (head["start"] - self.first) * self.each))
        gone = max(0, min(keep, (head["first"] - self.first) * self.each))
        self.x = [*self.x[gone:keep], *seconds]
        for k, name in enumerate(self.names):
            self.values[name] = [*self.values[name][gone:keep], *(block[k].astype(float) + self.offsets[k])]
        self.first = min(head["start"], max(self.first, head["first"]))


def readings(engine: FakeEngine, start: int, n: int, every: int = 100_000_000) -> Events:
    rng = np.random.default_rng(start)
    t = (np.arange(start, start + n)) * every + SECOND
    value = np.full((n, engine.model.width), np.nan)
    value[:, 0] = 25.0 + rng.normal(size=n)
    kind = np.where(np.arange(n) % 10 == 9, TRUTH, READING).astype(np.int8)
    return Events(t, t, kind, np.zeros(n, np.int32), value)


def look(series: Series, **wanted: Any) -> tuple[ChartStream, Browser]:
    lane = ChartStream("charts", ChartQuery(**wanted), series.columns)
    series.open(lane)
    return lane, Browser()


def whole(series: Series, **wanted: Any) -> Browser:
    lane, browser = look(series, **wanted)
    for frame in series.frames([lane]):
        browser.take(frame)
    series.close(lane)
    return browser


@pytest.fixture
def engine() -> FakeEngine:
    return FakeEngine(MODEL, "kf")


@pytest.mark.parametrize("wanted", [{}, {"span": 30.0}, {"since": 10.0, "until": 60.0}])
@pytest.mark.parametrize("points", [40, 600])
def test_small_frames_are_as_good_as_one(engine: FakeEngine, wanted: dict, points: int) -> None:
    series = Series(engine)
    names = tuple(series.columns)
    lane, browser = look(series, columns=names, points=points, **wanted)
    for k in range(30):
        engine.put(readings(engine, 37 * k, 37))
        for frame in series.frames([lane]):
            browser.take(frame)
        for frame in series.frames([lane]):
            raise AssertionError(f"nothing has changed, and {len(frame)} bytes were sent")
    # Of one size of group: which one it is may depend on what was shown before.
    fresh, again = look(series, columns=names, points=points, **wanted)
    fresh._size = lane._size
    for frame in series.frames([fresh]):
        again.take(frame)
    assert len(again.x) > 10
    np.testing.assert_array_equal(browser.x[-len(again.x) :], again.x)
    for name in names:
        np.testing.assert_allclose(browser.values[name][-len(again.x) :], again.values[name], rtol=1e-6, atol=1e-5)


def test_only_what_is_far_away_has_levels(engine: FakeEngine) -> None:
    """And what is near, or was looked at from afar, holds what it would without."""
    engine.put(readings(engine, 0, 20_000))
    series = Series(engine)
    names = tuple(series.columns)
    near, close = look(series, columns=names, span=30.0)
    far, _ = look(series, columns=("health",))
    close.take(series.frames([near, far])[0])
    assert series._live is not None and series._live._levels.asked == ["health"]
    alone = whole(Series(engine), columns=names, span=30.0)
    np.testing.assert_array_equal(close.x, alone.x)
    for name in names:
        np.testing.assert_array_equal(close.values[name], alone.values[name])
    wide, from_afar = look(series, columns=("nis",))
    for frame in series.frames([wide]):
        from_afar.take(frame)
    assert series._live._levels.asked == ["health", "nis"]
    alone = whole(Series(engine), columns=("nis",))
    np.testing.assert_array_equal(from_afar.values["nis"], alone.values["nis"])
    # Nobody looks at it any more, and another revision begins.
    series.close(wide)
    engine.submit(SetTuning("Q.rate", 0.5))
    assert series.frames([near, far])
    assert series._live._levels.asked == ["health"]


@pytest.mark.parametrize("points", [40, 600])
@pytest.mark.parametrize("wanted", [{}, {"span": 8.0}, {"since": 1.0, "until": 11.5}])
def test_rows_that_come_while_a_frame_is_made_are_sent_with_the_next(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch, points: int, wanted: dict
) -> None:
    """Nothing comes after them, which would bring them along."""
    series, coming = Series(engine), [readings(engine, 100, 37)]
    lane, browser = look(series, columns=(MEAN,), points=points, **wanted)
    engine.put(readings(engine, 0, 100))
    pull = engine.pull

    def pull_later(*given: Any, **options: Any) -> Pull:
        if coming:
            engine.put(coming.pop())
        return pull(*given, **options)

    monkeypatch.setattr(engine, "pull", pull_later)
    for _ in range(2):
        for frame in series.frames([lane]):
            browser.take(frame)
    assert series.frames([lane]) == []
    again = whole(series, columns=(MEAN,), points=points, **wanted)
    np.testing.assert_array_equal(browser.x[-len(again.x) :], again.x)
    np.testing.assert_allclose(browser.values[MEAN][-len(again.x) :], again.values[MEAN], rtol=1e-6)


def test_what_a_name_stands_for_may_change_while_frames_are_made(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine.put(readings(engine, 0, 5000))
    series = Series(engine)
    monkeypatch.setattr(engine, "previous", lambda: engine._pull(0, True))
    lanes = [look(series, columns=(name,), run="previous", points=20)[0] for name in (MEAN, "nis")]
    assert len(series.frames(lanes)) == 2


def test_points_are_no_more_than_asked_for(engine: FakeEngine) -> None:
    engine.put(readings(engine, 0, 20_000))
    series = Series(engine)
    for points in (10, 100, 1000):
        shown = whole(series, columns=(MEAN,), points=points)
        assert points / 4 / 1.3 < len(shown.x) / 2 <= 1.3 * points + 2


def test_a_peak_of_one_row_is_seen_however_many_there_are(engine: FakeEngine) -> None:
    events = readings(engine, 0, 30_000)
    events.value[17_777, 0] = 80.0
    engine.put(events)
    shown = whole(Series(engine), columns=(f"reading:{ROW}", "refused:winding", "nis"), points=50)
    assert max(np.nanmax(shown.values[f"reading:{ROW}"]), np.nanmax(shown.values["refused:winding"])) == pytest.approx(
        80
    )


def test_a_late_reading_is_sent_again_from_there_on(engine: FakeEngine) -> None:
    series = Series(engine)
    names = (MEAN, f"reading:{ROW}")
    lane, browser = look(series, columns=names)
    engine.put(readings(engine, 0, 200))
    for frame in series.frames([lane]):
        browser.take(frame)
    before = browser.bytes
    late = readings(engine, 0, 1)._replace(t=np.array([15 * SECOND + 1]), arrival=np.array([30 * SECOND]))
    engine.put(late)
    for frame in series.frames([lane]):
        browser.take(frame)
    assert browser.bytes - before < before
    again = whole(series, columns=names)
    np.testing.assert_array_equal(browser.x, again.x)
    np.testing.assert_allclose(browser.values[MEAN], again.values[MEAN], rtol=1e-6)


def test_nobody_looks_and_nothing_is_kept(engine: FakeEngine) -> None:
    engine.put(readings(engine, 0, 100))
    series = Series(engine)
    lane, _ = look(series, columns=("nis",))
    assert series.frames([lane])
    series.close(lane)
    assert series._live is None


def test_two_points_a_group() -> None:
    """A line's extremes in the order in which they lead on; a band's edge twice; a dot that is alone once."""
    t = np.arange(4) * SECOND
    values = np.array([[1.0, 1.0, 1.0, np.nan], [5.0, 5.0, 5.0, 3.0], [0.0, 0.0, 0.0, np.nan], [2.0, 2.0, 2.0, np.nan]])
    times, points = drawn(grouped(4, 0, t, values), np.array(["line", "upper", "lower", "dots"]))
    np.testing.assert_array_equal(times, [0, 3 * SECOND])
    np.testing.assert_array_equal(points, [[0.0, 5.0, 0.0, 3.0], [5.0, 5.0, 0.0, np.nan]])


def test_a_kept_revision_is_shown_beside(engine: FakeEngine) -> None:
    engine.put(readings(engine, 0, 500))
    fold = engine.fold
    engine.before = Pull(7, False, 0, Events(*(c.copy() for c in fold.log.events)), fold.track.select(slice(0, fold.n)))
    series = Series(engine)
    shown = whole(series, columns=(MEAN,), run="previous", points=600)
    np.testing.assert_allclose(shown.values[MEAN], fold.track.mean[: fold.n, 0], rtol=1e-6)
    assert whole(series, columns=(MEAN,), run="99").x == []
