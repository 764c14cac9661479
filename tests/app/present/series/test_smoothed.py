"""The lane of the smoothed estimate: against a smoothed fold of the same log, again with new events, or a reason."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.live import commands
from app.live.jobs import Job, Jobs
from app.live.notices import Notices
from app.live.outputs import event_window
from app.present.series.chart_stream import ChartQuery, ChartStream
from app.present.series.series import SMOOTHED, Series
from app.present.series.smoothed import Smoother
from estimators import fold
from estimators.events.maintenance import maintained
from estimators.fold import Fold
from estimators.log import Events, Log
from estimators.tuning import Tuning
from tests.app.present.series.test_pinned import MEAN, N, taken, values
from tests.app.scripted import MODEL, Stepped, readings

UPPER = MEAN.replace("mean", "upper")


@pytest.fixture
def stepped():
    made = Stepped()
    t, y = values(2 * N)
    made.put(readings(t[:N], y[:N]))
    return made


def smoothed(tuning, n):
    log = Log.of(MODEL)
    t, y = values(2 * N)
    log.extend(readings(t[:n], y[:n]))
    return fold("kf", MODEL, log, tuning=tuning, smoothed=True)


def shown(series, lane):
    """The last frame after the smoother has looked again."""
    before = taken(series, lane)
    series._smoothing.look(Job("test"))
    return taken(series, lane) or before


def test_smoothed_rows_carry_the_version_of_the_model():
    """After a maintenance before the window; its log once restarted at version 1."""
    log = Log.of(MODEL)
    t, y = values(N)
    log.extend(Events.concat([readings(t, y), maintained(int(t[10]), int(t[10]), [0], MODEL.width)], MODEL.width))
    fold = Fold("kf", MODEL, Tuning.of(MODEL), log)
    fold.advance()
    notices = Notices(lambda: 0)
    engine = SimpleNamespace(
        last_events=lambda limit: event_window(fold, 1, N // 2), estimator="kf", notices=notices, jobs=Jobs(notices)
    )
    smoother = Smoother(engine)
    smoother.look(Job("test"))
    assert smoother.latest.version == 2


def test_it_is_the_smoothed_fold_and_follows_the_running_one(stepped):
    series = Series(stepped.engine)
    lane = ChartStream("smoothed", ChartQuery((MEAN, UPPER), run=SMOOTHED, points=4000), series.columns)
    series.open(lane)
    first, expected = shown(series, lane), smoothed(Tuning.of(MODEL), N)
    # Single precision of the wire.
    np.testing.assert_allclose(first.values[MEAN], expected.mean[:, 0], rtol=1e-6)
    np.testing.assert_allclose(first.values[UPPER], expected.mean[:, 0] + 2 * expected.std[:, 0], rtol=1e-6)
    t, y = values(2 * N)
    stepped.put(readings(t[N:], y[N:]))
    second = shown(series, lane)
    np.testing.assert_allclose(second.values[MEAN], smoothed(Tuning.of(MODEL), 2 * N).mean[:, 0], rtol=1e-6)
    stepped.submit(commands.SetTuning("Q.rate", 0.1))
    other = smoothed(Tuning.of(MODEL).set("Q.rate", 0.1), 2 * N).mean[:, 0]
    np.testing.assert_allclose(shown(series, lane).values[MEAN], other, rtol=1e-6)
    job = series._smoothing._job
    series.close(lane)
    assert not job.wanted


def test_a_filter_that_cannot_be_smoothed_gives_the_reason(stepped):
    stepped.submit(commands.SetEstimator("filterpy-kf"))
    series = Series(stepped.engine)
    lane = ChartStream("smoothed", ChartQuery((MEAN,), run=SMOOTHED), series.columns)
    series.open(lane)
    assert shown(series, lane) is None
    assert any("filterpy-kf cannot be smoothed" in text for text in stepped.notices())
    series.close(lane)
