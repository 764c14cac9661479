"""The lane of what runs, smoothed: against a fold of the same log, again when something came, and never in silence."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.live import commands
from app.live.engine import Engine
from app.live.integrity import window
from app.live.notices import Notices
from app.present.series.chart_stream import ChartQuery, ChartStream
from app.present.series.series import SMOOTHED, Series
from app.present.series.smoothed import Smoothing
from estimators import fold
from estimators.events.maintenance import maintained
from estimators.fold import Fold
from estimators.log import Events, Log
from estimators.tuning import Tuning
from tests.app.live.runs.test_scores import carry_out
from tests.app.present.series.test_pinned import MEAN, N, taken, values
from tests.app.scripted import MODEL, Scripted, readings, row_count, twin, wait_for

UPPER = MEAN.replace("mean", "upper")


@pytest.fixture
def source_and_engine():
    source = Scripted()
    running = Engine(twin(), lambda report: source)
    running.start()
    t, y = values(2 * N)
    source.put(readings(t[:N], y[:N]))
    wait_for(lambda: row_count(running) == N)
    yield source, running
    running.stop()


def smoothed(estimator, tuning, n):
    log = Log.of(MODEL)
    t, y = values(2 * N)
    log.extend(readings(t[:n], y[:n]))
    return fold(estimator, MODEL, log, tuning=tuning, smoothed=True)


def shown(series, lane, wanted):
    """The browser that has what is wanted; a frame comes whenever there is one."""
    last = []

    def there():
        browser = taken(series, lane)
        last[:] = [browser] if browser is not None else last
        return bool(last) and wanted(last[0])

    wait_for(there, seconds=120.0)
    return last[0]


def test_smoothed_rows_carry_the_version_of_the_model():
    """After a maintenance before the window; its log once restarted at version 1."""
    log = Log.of(MODEL)
    t, y = values(N)
    log.extend(Events.concat([readings(t, y), maintained(int(t[10]), int(t[10]), [0], MODEL.width)], MODEL.width))
    fold = Fold("kf", MODEL, Tuning.of(MODEL), log)
    fold.advance()
    engine = SimpleNamespace(
        last_events=lambda most: window(fold, 1, most=N // 2), estimator="kf", notices=Notices(lambda: 0)
    )
    smoothing = Smoothing(engine)
    wait_for(lambda: smoothing.latest is not None, seconds=120.0)
    smoothing.stop()
    assert smoothing.latest.version == 2


def test_it_is_the_smoothed_fold_and_follows_what_runs(source_and_engine):
    source, engine = source_and_engine
    series = Series(engine)
    lane = ChartStream("smoothed", ChartQuery((MEAN, UPPER), run=SMOOTHED, points=4000), series.columns)
    series.open(lane)
    first = shown(series, lane, lambda browser: len(browser.x) == N)
    expected = smoothed("kf", Tuning.of(MODEL), N)
    # Single precision of the wire.
    np.testing.assert_allclose(first.values[MEAN], expected.mean[:, 0], rtol=1e-6)
    np.testing.assert_allclose(first.values[UPPER], expected.mean[:, 0] + 2 * expected.std[:, 0], rtol=1e-6)
    t, y = values(2 * N)
    source.put(readings(t[N:], y[N:]))
    second = shown(series, lane, lambda browser: len(browser.x) == 2 * N)
    np.testing.assert_allclose(second.values[MEAN], smoothed("kf", Tuning.of(MODEL), 2 * N).mean[:, 0], rtol=1e-6)
    carry_out(engine, commands.SetTuning("Q.rate", 0.1))
    other = smoothed("kf", Tuning.of(MODEL).set("Q.rate", 0.1), 2 * N).mean[:, 0]
    shown(series, lane, lambda browser: np.allclose(browser.values[MEAN], other, rtol=1e-6))
    thread = series._smoothing._thread
    series.close(lane)
    wait_for(lambda: not thread.is_alive())


def test_why_there_is_nothing_is_said(source_and_engine):
    _, engine = source_and_engine
    carry_out(engine, commands.SetEstimator("filterpy-kf"))
    series = Series(engine)
    lane = ChartStream("smoothed", ChartQuery((MEAN,), run=SMOOTHED), series.columns)
    series.open(lane)

    def told():
        assert taken(series, lane) is None
        return any("filterpy-kf cannot be smoothed" in notice.text for notice in engine.notices.since(0))

    wait_for(told, seconds=60.0)
    series.close(lane)
