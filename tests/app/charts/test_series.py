"""Chart streams: a browser has the rows of the fold, however they arrived; runs are the folds that they name."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.charts.chart_stream import MAX_DOT_ROWS, ChartQuery, ChartStream, drawn
from app.charts.levels_of_detail import grouped
from app.charts.series import SMOOTHED, Series
from app.derive.background_folds import PinnedFold, Smoother
from app.engine import commands
from app.engine.copies import event_window
from app.engine.jobs import Job, Jobs
from app.engine.notices import Notices
from estimators import fold
from estimators.events.maintenance import maintained
from estimators.fold import Fold
from estimators.log import TRUTH, Events, Log
from estimators.tuning import Tuning
from tests.app.scripted import MODEL, Replayed, Stepped, decoded, random_walk, readings
from tests.support import SECOND
from tests.waiting import wait_for

ROW = MODEL.row_names[0]
MEAN, UPPER, READING = f"mean:{MODEL.states[0].name}", f"upper:{MODEL.states[0].name}", f"reading:{ROW}"
FIRST = Tuning.of(MODEL)
N = 900


class Viewer:
    """Chart stream of a browser and its points, kept as app/web/page/stream.js keeps them."""

    def __init__(self, series, *columns, **query):
        self.series, self.bytes = series, 0
        self.x, self.values = np.zeros(0), {}
        self.stream = ChartStream("charts", ChartQuery(columns, **query), series.columns)
        series.open(self.stream)

    def look(self):
        """Take the next frames; return how many there were."""
        frames = self.series.frames([self.stream])
        for frame in frames:
            self.take(frame)
        return len(frames)

    def take(self, frame):
        self.bytes += len(frame)
        head, seconds, block = decoded(frame)
        if head["fresh"]:
            self.names, self.x, self.values = head["columns"], np.zeros(0), dict.fromkeys(head["columns"], np.zeros(0))
            self.first, self.each = head["start"], head["each"]
        if head["offsets"] is not None:
            self.offsets = head["offsets"]
        keep = max(0, min(len(self.x), (head["start"] - self.first) * self.each))
        gone = max(0, min(keep, (head["first"] - self.first) * self.each))
        self.x = np.concatenate((self.x[gone:keep], seconds))
        for k, name in enumerate(self.names):
            self.values[name] = np.concatenate((self.values[name][gone:keep], block[k] + self.offsets[k]))
        self.first = min(head["start"], max(self.first, head["first"]))

    def until(self, engine, holds):
        """Take frames until the points are as asked; return the values of the first column."""

        def there():
            engine.settle()
            self.look()
            return holds(self)

        wait_for(there)
        return self.values[self.names[0]]

    def close(self):
        self.series.close(self.stream)


def shown(engine, *columns, **query):
    """Points that a new browser gets at once."""
    viewer = Viewer(Series(engine), *columns, **query)
    viewer.look()
    viewer.close()
    return viewer


def same(viewer, other, exact=False):
    """The last points of a viewer are those of another, to the single precision of the wire."""
    n = len(other.x)
    assert n > 10
    np.testing.assert_array_equal(viewer.x[-n:], other.x)
    for name, values in other.values.items():
        np.testing.assert_allclose(
            viewer.values[name][-n:], values, rtol=0 if exact else 1e-6, atol=0 if exact else 1e-5
        )


def measured(n, start=0):
    """n events at 10 Hz of a winding at 25 °C, each tenth one its true state."""
    batch = readings((start + np.arange(n)) * 0.1 + 1.0, 25.0 + np.random.default_rng(start).normal(size=n))
    value = np.full((n, MODEL.width), np.nan)
    value[:, :1] = batch.value
    return batch._replace(value=value, kind=np.where(np.arange(n) % 10 == 9, TRUTH, batch.kind).astype(np.int8))


def stepped_with(n, **options):
    stepped = Stepped(**options).put(measured(n))
    return stepped


# Frames


@pytest.mark.parametrize("query", [{}, {"span": 30.0}, {"since": 10.0, "until": 60.0}])
@pytest.mark.parametrize("points", [40, 600])
def test_small_frames_are_as_good_as_one(query, points):
    stepped = Stepped()
    series = Series(stepped.engine)
    viewer = Viewer(series, *series.columns, points=points, **query)
    for k in range(30):
        stepped.put(measured(37, 37 * k))
        viewer.look()
        assert viewer.look() == 0  # nothing has changed
    fresh = Viewer(series, *series.columns, points=points, **query)
    fresh.stream.size = viewer.stream.size  # which depends on the frames before
    fresh.look()
    same(viewer, fresh)


def test_only_columns_that_are_shown_from_afar_have_levels_of_detail():
    stepped = stepped_with(20_000)
    series = Series(stepped.engine)
    near, far = Viewer(series, *series.columns, span=30.0), Viewer(series, "health")
    assert len(series.frames([near.stream, far.stream])) == 2 and series.runs["live"].levelled == ["health"]
    wide = Viewer(series, "nis")
    wide.look()
    assert series.runs["live"].levelled == ["health", "nis"]
    same(wide, shown(stepped.engine, "nis"), exact=True)
    # Once no stream shows it, another revision drops it.
    wide.close()
    stepped.submit(commands.SetTuning("Q.rate", 0.5))
    assert len(series.frames([near.stream, far.stream])) == 2 and series.runs["live"].levelled == ["health"]
    near.close()
    far.close()
    assert not series.runs


@pytest.mark.parametrize("points", [40, 600])
@pytest.mark.parametrize("query", [{}, {"span": 8.0}, {"since": 1.0, "until": 11.5}])
def test_rows_that_arrive_while_a_frame_is_made_are_in_the_next_one(monkeypatch, points, query):
    """No row follows that would bring them along."""
    stepped = stepped_with(100)
    viewer, later = Viewer(Series(stepped.engine), MEAN, points=points, **query), [measured(37, 100)]
    pull = stepped.engine.pull

    def pull_later(*given, **options):
        if later:
            stepped.put(later.pop())
        return pull(*given, **options)

    monkeypatch.setattr(stepped.engine, "pull", pull_later)
    viewer.look()
    viewer.look()
    assert viewer.look() == 0
    same(viewer, shown(stepped.engine, MEAN, points=points, **query))


def test_points_are_no_more_than_asked_for():
    engine = stepped_with(20_000).engine
    for points in (10, 100, 1000):
        assert points / 4 / 1.3 < len(shown(engine, MEAN, points=points).x) / 2 <= 1.3 * points + 2


@pytest.mark.parametrize("rows", [9_000, 102_400])
def test_noise_looks_like_noise_from_any_distance(rows):
    """Up to `MAX_DOT_ROWS` all are drawn; of more, a sample with the quartiles of all, and the extremes."""
    noise = np.random.default_rng(1).normal(size=rows)
    stepped = Stepped(horizon=np.inf).put(readings(np.arange(1.0, rows + 1.0), noise))
    viewer = shown(stepped.engine, READING, points=400)
    drawn = viewer.values[READING][np.isfinite(viewer.values[READING])]
    assert drawn.max() == pytest.approx(noise.max(), abs=1e-6) and drawn.min() == pytest.approx(noise.min(), abs=1e-6)
    if rows <= MAX_DOT_ROWS:
        np.testing.assert_allclose(drawn, noise, atol=1e-6)
        return
    groups = -(-rows // viewer.stream.size)
    assert drawn.size == groups * (MAX_DOT_ROWS // 400 + 2)
    # The extremes of some hundred rows lie outside the quartiles.
    within, sampled = np.sum(np.abs(drawn) < 0.6745), drawn.size - 2 * groups
    assert within == pytest.approx(0.5 * sampled, abs=4.0 * np.sqrt(0.25 * sampled))


def test_a_peak_of_one_row_is_seen_at_any_scale():
    events = measured(30_000)
    events.value[17_777, 0] = 80.0
    stepped = Stepped().put(events)
    viewer = shown(stepped.engine, READING, f"refused:{ROW}", "nis", points=50)
    assert np.nanmax([viewer.values[READING], viewer.values[f"refused:{ROW}"]]) == pytest.approx(80)


def test_a_late_measurement_replaces_the_rows_from_there_on():
    stepped = Stepped(horizon=60.0)
    viewer = Viewer(Series(stepped.engine), MEAN, READING)
    stepped.put(measured(200))
    viewer.look()
    before = viewer.bytes
    stepped.put(readings([15.05], [25.0]))
    viewer.look()
    assert viewer.bytes - before < before and len(viewer.x) == 201
    same(viewer, shown(stepped.engine, MEAN, READING))


def test_rows_of_a_log_that_began_again_replace_those_before_also_where_there_are_none_yet():
    stepped = Stepped(source=Replayed()).put(measured(700))
    viewer = Viewer(Series(stepped.engine), MEAN, since=10.0, until=60.0)
    viewer.look()
    assert len(viewer.x) > 400
    stepped.source.restart()
    stepped.put(measured(20))
    viewer.look()
    assert len(viewer.x) <= 1 and all(viewer.x < 10.0)


def test_two_points_a_group():
    """A line's extremes in the order in which they lead on; a band's edge twice; a dot that is alone once."""
    t = np.arange(4) * SECOND
    values = np.array([[1.0, 1.0, 1.0, np.nan], [5.0, 5.0, 5.0, 3.0], [0.0, 0.0, 0.0, np.nan], [2.0, 2.0, 2.0, np.nan]])
    times, points = drawn(grouped(4, 0, t, values), np.array(["line", "upper", "lower", "dots"]))
    np.testing.assert_array_equal(times, [0, 3 * SECOND])
    np.testing.assert_array_equal(points, [[0.0, 5.0, 0.0, 3.0], [5.0, 5.0, 0.0, np.nan]])


# Previous, pinned and smoothed runs against the folds themselves


def walk(n):
    """n measurements; more of them begin with the same ones."""
    (_, y), (_, rest) = random_walk(N, seed=8), random_walk(max(1, n - N), seed=9)
    return np.arange(1, n + 1) * 0.1, np.concatenate((y, rest))[:n] if n > N else y[:n]


def folded(tuning, n, late=(), **options):
    log = Log.of(MODEL)
    for t, y in (walk(n), *(([t], [y]) for t, y in late)):
        log.extend(readings(t, y))
    return fold("kf", MODEL, log, tuning=tuning, **options)


def mean(tuning, n=N, late=()):
    return folded(tuning, n, late).mean[:, 0]


SECOND_RUN = FIRST.set("Q.rate", 0.1)


@pytest.fixture
def stepped():
    """Run 0 is pinned, run 1 with another Q runs."""
    made = Stepped().put(readings(*walk(N)))
    made.submit(commands.Pin(0), commands.SetTuning("Q.rate", 0.1))
    return made


def go_on(stepped, n):
    """The asset goes on, up to n measurements."""
    t, y = walk(n)
    stepped.put(readings(t[N:], y[N:]))


@pytest.mark.parametrize("run", ["0", "previous"])
def test_a_kept_run_has_its_own_points(stepped, run):
    viewer = shown(stepped.engine, MEAN, run=run, points=2000)
    np.testing.assert_allclose(viewer.x, np.arange(N) * 0.1, atol=1e-9)
    np.testing.assert_allclose(viewer.values[MEAN], mean(FIRST), rtol=1e-6)


def test_a_difference_is_that_of_the_same_rows_and_follows_the_running_fold(stepped):
    viewer = Viewer(Series(stepped.engine), MEAN, run="difference:0", points=2000)
    viewer.look()
    expected = mean(FIRST) - mean(SECOND_RUN)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(viewer.values[MEAN], expected, atol=1e-5)
    assert viewer.look() == 0
    stepped.submit(commands.SetTuning("R.winding", 3.0))
    viewer.look()
    expected = mean(FIRST) - mean(SECOND_RUN.set("R.winding", 3.0))
    np.testing.assert_allclose(viewer.values[MEAN], expected, atol=1e-5)


def test_runs_that_are_not_pinned_have_no_points(stepped):
    for run in ("1", "99", "difference:7"):
        assert not shown(stepped.engine, MEAN, run=run).x.size
    stepped.submit(commands.Unpin(0))
    assert not shown(stepped.engine, MEAN, run="0").x.size


@pytest.mark.parametrize("run", ["0", "difference:0"])
def test_a_pinned_run_goes_on_with_the_asset(stepped, run):
    """Measurements after the end of its rows, and a late one, are folded with its own settings."""
    n, engine = N + 300, stepped.engine
    viewer = Viewer(Series(engine), MEAN, run=run, points=2000)
    assert viewer.until(engine, lambda viewer: len(viewer.x)).size == N

    def expected(late=()):
        own = mean(FIRST, n, late)
        return own if run == "0" else own - mean(SECOND_RUN, n, late)

    go_on(stepped, n)
    np.testing.assert_allclose(viewer.until(engine, lambda viewer: len(viewer.x) == n), expected(), atol=2e-5)
    late = (float(walk(n)[0][-6]) + 0.05, 55.0)
    stepped.put(readings([late[0]], [late[1]]))
    points = viewer.until(engine, lambda viewer: len(viewer.x) == n + 1)
    np.testing.assert_allclose(points, expected([late]), atol=2e-5)


def test_few_points_of_a_pinned_run_that_goes_on_have_its_extremes(stepped):
    viewer, last = Viewer(Series(stepped.engine), MEAN, run="0", points=50), (N + 299) * 0.1
    go_on(stepped, N + 300)
    points = viewer.until(stepped.engine, lambda viewer: len(viewer.x) and viewer.x[-1] == pytest.approx(last))
    assert len(points) < 300 and np.nanmax(points) == pytest.approx(mean(FIRST, N + 300).max(), abs=2e-5)


@pytest.mark.parametrize("run", ["0", "difference:0"])
def test_a_pinned_run_is_folded_only_while_measurements_come_and_somebody_looks(stepped, monkeypatch, run):
    engine, jobs = stepped.engine, []
    begin = engine.jobs.run
    monkeypatch.setattr(engine.jobs, "run", lambda *given, **options: jobs.append(begin(*given, **options)) or jobs[-1])
    viewer = Viewer(Series(engine), MEAN, run=run, points=2000)
    assert viewer.until(engine, lambda viewer: len(viewer.x)).size == N and not jobs
    go_on(stepped, N + 10)
    viewer.until(engine, lambda viewer: len(viewer.x) == N + 10)
    assert [job.cancelled for job in jobs] == [False]
    viewer.series.close(viewer.stream)
    assert [job.cancelled for job in jobs] == [True] and not viewer.series.runs


def caught_up(engine, pinned):
    """Let the fold of a pinned run take all events, and compare them with the engine's."""
    for _ in range(20):
        pinned.follow(Job("test"))
    own, running = pinned.rows(0, 10**9), engine.rows(0, 10**9)
    assert own.first == running.first
    np.testing.assert_array_equal(own.events.t, running.events.t)
    np.testing.assert_array_equal(own.events.value, running.events.value)
    return own


def test_a_pinned_run_outlives_events_that_were_dropped_before_it_took_them():
    stepped = Stepped(history=2048)
    t, y = np.arange(1, 16_001) * 0.1, 40 + np.random.default_rng(4).normal(size=16_000)
    stepped.put(readings(t[:1000], y[:1000]))
    engine = stepped.engine
    pinned = PinnedFold(engine, engine.revisions.find(0))
    assert len(caught_up(engine, pinned).events) == 1000
    pinned.job.cancel()  # the test alone follows
    stepped.put(readings(t[1000:], y[1000:]))
    own = caught_up(engine, pinned)
    assert own.first > 2000 and np.abs(own.track.mean[-1, 0] - 40.0) < 2.0


def test_a_pinned_run_goes_on_where_the_log_begins_again():
    stepped = Stepped(source=Replayed()).put(readings(*walk(N)))
    stepped.submit(commands.Pin(0), commands.SetTuning("Q.rate", 0.1))
    engine = stepped.engine
    pinned = PinnedFold(engine, engine.revisions.find(0))
    assert len(caught_up(engine, pinned).events) == N and pinned.caught_up
    stepped.source.restart()
    again = readings(*random_walk(2 * N, seed=10))
    stepped.put(again)
    own, log = caught_up(engine, pinned), Log.of(MODEL)
    log.extend(again)
    np.testing.assert_array_equal(own.track.mean, fold("kf", MODEL, log, tuning=FIRST).mean)


def test_a_pinned_run_that_fails_ends_and_its_kept_rows_stay(stepped):
    engine = stepped.engine
    pinned = PinnedFold(engine, engine.revisions.find(0))
    go_on(stepped, N + 10)
    caught_up(engine, pinned)
    pinned.fail("no such luck")
    assert not pinned.caught_up and any("run 0" in text and "no such luck" in text for text in stepped.notices())


def test_the_smoothed_run_is_the_smoothed_fold_and_follows_the_running_one(monkeypatch):
    smoothers = []
    monkeypatch.setattr(Smoother, "__init__", _without_a_job(Smoother.__init__, smoothers))
    stepped = Stepped().put(readings(*walk(N)))
    viewer = Viewer(Series(stepped.engine), MEAN, UPPER, run=SMOOTHED, points=4000)
    assert viewer.look() == 0

    def compared(tuning, n):
        smoothers[0].update(Job("test"))
        viewer.look()
        expected = folded(tuning, n, smoothed=True)
        np.testing.assert_allclose(viewer.values[MEAN], expected.mean[:, 0], rtol=1e-6)
        np.testing.assert_allclose(viewer.values[UPPER], expected.mean[:, 0] + 2 * expected.std[:, 0], rtol=1e-6)

    compared(FIRST, N)
    go_on(stepped, 2 * N)
    compared(FIRST, 2 * N)
    stepped.submit(commands.SetTuning("Q.rate", 0.1))
    compared(SECOND_RUN, 2 * N)
    job = smoothers[0].job
    viewer.close()
    assert not job.wanted
    # A filter without a smoother gives the reason.
    stepped.submit(commands.SetEstimator("filterpy-kf"))
    viewer = Viewer(Series(stepped.engine), MEAN, run=SMOOTHED)
    assert viewer.look() == 0
    smoothers[1].update(Job("test"))
    assert viewer.look() == 0
    assert any("filterpy-kf cannot be smoothed" in text for text in stepped.notices())


def _without_a_job(init, made):
    """Smoothers are collected, so that a test calls `update` itself."""

    def collected(self, engine):
        init(self, engine)
        made.append(self)

    return collected


def test_smoothed_rows_carry_the_version_of_the_model():
    """After a maintenance before the window; its log once restarted at version 1."""
    log = Log.of(MODEL)
    t, y = walk(N)
    log.extend(Events.concat([readings(t, y), maintained(int(t[10]), int(t[10]), [0], MODEL.width)], MODEL.width))
    running = Fold("kf", MODEL, FIRST, log)
    running.advance()
    notices = Notices(lambda: 0)
    smoother = Smoother(
        SimpleNamespace(
            last_events=lambda limit: event_window(running, 1, N // 2),
            estimator="kf",
            notices=notices,
            jobs=Jobs(notices),
        )
    )
    smoother.update(Job("test"))
    assert smoother.latest.version == 2
