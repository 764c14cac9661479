"""Lanes of pinned runs, and of what they differ by from what runs, against the folds themselves."""

import numpy as np
import pytest

from app.live import commands
from app.live.jobs import Job
from app.present.series.chart_stream import ChartQuery, ChartStream
from app.present.series.pinned_runs import PinnedFold
from app.present.series.series import Series
from estimators.fold import fold
from estimators.log import Log
from estimators.tuning import Tuning
from tests.app.present.series.test_chart_stream import Browser
from tests.app.scripted import MODEL, Replayed, Stepped, readings, wait_for

MEAN = f"mean:{MODEL.states[0].name}"
FIRST = Tuning.of(MODEL)
N = 900


def values(n, seed=8):
    rng = np.random.default_rng(seed)
    return np.arange(1, n + 1) * 0.1, 40 + np.cumsum(rng.normal(size=n)) * 0.1 + rng.normal(size=n)


@pytest.fixture
def stepped():
    """Run 0 is pinned, run 1 with another Q runs."""
    made = Stepped()
    made.put(readings(*values(N)))
    made.submit(commands.Pin(0), commands.SetTuning("Q.rate", 0.1))
    return made


def mean(tuning):
    log = Log(MODEL.width)
    log.extend(readings(*values(N)))
    return fold("kf", MODEL, tuning, log).mean[:, 0]


def taken(series, lane):
    """What a browser has after this lane's next frame; None if there is none."""
    frames, browser = series.frames([lane]), Browser()
    for frame in frames:
        browser.take(frame)
    return browser if frames else None


def points(series, run):
    lane = ChartStream("pinned", ChartQuery((MEAN,), run=run, points=2000), series.columns)
    series.open(lane)
    found = taken(series, lane)
    series.close(lane)
    return found


def test_a_pinned_run_gives_its_own_points(stepped):
    shown = points(Series(stepped.engine), "0")
    np.testing.assert_allclose(shown.x, np.arange(N) * 0.1, atol=1e-9)
    np.testing.assert_allclose(shown.values[MEAN], mean(FIRST), rtol=1e-6)


def test_a_difference_is_that_of_the_same_rows_and_follows_what_runs(stepped):
    series = Series(stepped.engine)
    lane = ChartStream("less", ChartQuery((MEAN,), run="difference:0", points=2000), series.columns)
    series.open(lane)
    expected = mean(FIRST) - mean(FIRST.set("Q.rate", 0.1))
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(taken(series, lane).values[MEAN], expected, atol=1e-5)
    assert taken(series, lane) is None
    stepped.submit(commands.SetTuning("R.winding", 3.0))
    expected = mean(FIRST) - mean(FIRST.set("Q.rate", 0.1).set("R.winding", 3.0))
    np.testing.assert_allclose(taken(series, lane).values[MEAN], expected, atol=1e-5)


def test_what_is_not_pinned_gives_nothing(stepped):
    series = Series(stepped.engine)
    assert points(series, "1") is None and points(series, "difference:7") is None
    stepped.submit(commands.Unpin(0))
    assert points(series, "0") is None


def test_nothing_is_held_of_a_run_that_nobody_looks_at(stepped):
    series = Series(stepped.engine)
    live = ChartStream("live", ChartQuery((MEAN,)), series.columns)
    series.open(live)
    assert points(series, "0") is not None and "0" in series._kept
    series.frames([live])
    assert series._kept == {}


def longer(n):
    """The readings of the fixture, and more of them."""
    (t, y), (later, rest) = values(N), values(n - N, seed=9)
    return np.concatenate((t, t[-1] + later)), np.concatenate((y, rest))


def all_of(tuning, n, late=()):
    log = Log(MODEL.width)
    log.extend(readings(*longer(n)))
    for t, value in late:
        log.extend(readings([t], [value]))
    return fold("kf", MODEL, tuning, log).mean[:, 0]


def go_on(stepped, n):
    """The asset goes on, up to n measurements."""
    t, y = longer(n)
    stepped.put(readings(t[N:], y[N:]))


class Watched:
    """A lane, and what its browser has."""

    def __init__(self, stepped, run, points=2000):
        self.engine, self.series = stepped.engine, Series(stepped.engine)
        self.lane = ChartStream("pinned", ChartQuery((MEAN,), run=run, points=points), self.series.columns)
        self.browser = Browser()
        self.series.open(self.lane)

    def until(self, there):
        """Take frames until the browser has what is asked; the values then."""

        def look():
            self.engine.settle()
            for frame in self.series.frames([self.lane]):
                self.browser.take(frame)
            return there(self.browser)

        wait_for(look)
        return np.asarray(self.browser.values[MEAN])

    def close(self):
        self.series.close(self.lane)
        assert not self.series._besides


@pytest.mark.parametrize("run", ["0", "difference:0"])
def test_a_pinned_run_goes_on_with_the_asset(stepped, run):
    """Readings that come after it gave way, and a late one, are folded as its own settings say."""
    n = N + 300

    def expected(late=()):
        own = all_of(FIRST, n, late)
        return own if run == "0" else own - all_of(FIRST.set("Q.rate", 0.1), n, late)

    watched = Watched(stepped, run)
    assert watched.until(lambda browser: len(browser.x)).size == N
    go_on(stepped, n)
    shown = watched.until(lambda browser: len(browser.x) == n)
    np.testing.assert_allclose(shown, expected(), atol=2e-5)
    late = (float(longer(n)[0][-6]) + 0.05, 55.0)
    stepped.put(readings([late[0]], [late[1]]))
    shown = watched.until(lambda browser: len(browser.x) == n + 1)
    np.testing.assert_allclose(shown, expected([late]), atol=2e-5)
    watched.close()


def test_few_points_of_one_that_goes_on_have_its_extremes(stepped):
    watched = Watched(stepped, "0", points=50)
    go_on(stepped, N + 300)
    shown = watched.until(lambda browser: len(browser.x) and browser.x[-1] == pytest.approx((N + 299) * 0.1))
    expected = all_of(FIRST, N + 300)
    assert len(shown) < 300 and np.nanmax(shown) == pytest.approx(expected.max(), abs=2e-5)
    watched.close()


def test_while_nothing_comes_nothing_is_folded(stepped):
    watched = Watched(stepped, "0")
    assert watched.until(lambda browser: len(browser.x)).size == N
    assert not watched.series._besides
    watched.close()


def caught_up(engine, fold):
    """Let the fold of a pinned run take all that there is, and compare its events with the engine's."""
    for _ in range(20):
        fold._follow(Job("test"))
    shown = fold.rows(0, 10**9)
    there = engine.rows(0, 10**9)
    assert shown.first == there.first and len(shown.events) == len(there.events)
    np.testing.assert_array_equal(shown.events.t, there.events.t)
    np.testing.assert_array_equal(shown.events.value, there.events.value)
    return shown


def test_a_pinned_run_outlives_events_that_were_forgotten_before_it_took_them():
    stepped = Stepped(history=2048)
    t, y = np.arange(1, 16_001) * 0.1, 40 + np.random.default_rng(4).normal(size=16_000)
    stepped.put(readings(t[:1000], y[:1000]))
    engine = stepped.engine
    own = PinnedFold(engine, engine.revisions.find(0))
    assert len(caught_up(engine, own).events) == 1000
    own._job.cancel()
    stepped.put(readings(t[1000:], y[1000:]))
    shown = caught_up(engine, own)
    assert shown.first > 2000 and np.abs(shown.track.mean[-1, 0] - 40.0) < 2.0


def test_a_pinned_run_goes_on_where_the_log_begins_again():
    stepped = Stepped(source=Replayed())
    stepped.put(readings(*values(N)))
    stepped.submit(commands.Pin(0), commands.SetTuning("Q.rate", 0.1))
    engine = stepped.engine
    own = PinnedFold(engine, engine.revisions.find(0))
    assert len(caught_up(engine, own).events) == N and own.caught_up
    stepped.source.restart()
    stepped.put(readings(*values(2 * N, seed=10)))
    shown = caught_up(engine, own)
    log = Log(MODEL.width)
    log.extend(readings(*values(2 * N, seed=10)))
    np.testing.assert_array_equal(shown.track.mean, fold("kf", MODEL, FIRST, log).mean)


def test_a_pinned_run_that_fails_ends_and_its_kept_rows_stay(stepped):
    watched = Watched(stepped, "0")
    assert watched.until(lambda browser: len(browser.x)).size == N
    go_on(stepped, N + 10)
    kept = watched.series._pulled("0")
    own = watched.series._beside("0", kept)
    own._fail("no such luck")
    assert not own.caught_up and any("run 0 is not continued: no such luck" in text for text in stepped.notices())
    watched.close()
