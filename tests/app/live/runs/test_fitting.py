"""A fit beside a running twin: the same as the fit of its log alone, told, cancelled, refused."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from app.live.engine import Engine
from app.live.history_copy import COPY_EVENTS
from app.live.runs.fitting import CANCELLED, DONE, FAILED, Fitting
from estimators.errors import ConfigError
from estimators.fit.fit import fit
from estimators.fit.recording import Recording
from estimators.log import Log
from estimators.tuning import Tuning
from tests.app.scripted import MODEL, Scripted, readings, row_count, twin, wait_for

FIRST = Tuning.of(MODEL)
WANTED = ["Q.rate", "R.winding"]


def series(n, seed=3):
    rng = np.random.default_rng(seed)
    return np.arange(1, n + 1) * 0.1, 40 + np.cumsum(rng.normal(size=n)) * 0.05 + rng.normal(size=n)


@pytest.fixture
def started():
    engines = []

    def start(n):
        source = Scripted()
        engine = Engine(twin(), lambda report: source)
        engines.append(engine)
        engine.start()
        if n:
            source.put(readings(*series(n)))
        wait_for(lambda: row_count(engine) == n)
        return engine

    yield start
    for engine in engines:
        engine.stop()


def ended(fitting):
    wait_for(lambda: fitting.latest.ended is not None)
    fitting._thread.join(60.0)
    return fitting.latest


def alone(n):
    log = Log(MODEL.width)
    log.extend(readings(*series(n)))
    return fit("kf", FIRST, [Recording(log)], wanted=WANTED)


def test_what_is_fitted_beside_the_twin_is_the_fit_of_its_log(started):
    # More than one piece is copied.
    n = COPY_EVENTS + 900
    engine = started(n)
    fitting = Fitting(engine)
    fitting.begin(WANTED)
    told, expected = ended(fitting), alone(n)
    assert (told.state, told.events, told.folds) == (DONE, n, expected.folds)
    assert told.seconds == pytest.approx(0.1 * (n - 1)) and told.elapsed > 0.0
    assert told.fitted.lines == expected.lines
    assert told.fitted.verdict == expected.verdict
    # Nothing was put in.
    assert engine.tuning is engine.twin.tuning and engine.revisions.runs[-1].number == 0


def test_the_last_events_are_folded_from_a_snapshot_on(started):
    engine = started(6000)
    fitting = Fitting(engine)
    fitting.begin(WANTED, 3000)
    told = ended(fitting)
    assert told.state == DONE and told.fitted.before.fitted.n + told.fitted.before.held_out.n == told.events
    # From the last snapshot at or before the event that was asked for.
    assert 3000 <= told.events < 6000


def test_a_data_sheet_bounds_it(started):
    engine = started(1500)
    free = alone(1500).lines[1].after
    # R was found below where the data sheet ends.
    bounds = (1.2 * free, FIRST.get("R.winding"))
    sheet = SimpleNamespace(bounds=bounds)
    engine.twin.config.sensors = {"winding": sheet}
    fitting = Fitting(engine)
    fitting.begin(WANTED)
    line = ended(fitting).fitted.lines[1]
    assert free < bounds[0] <= line.after <= bounds[1]


def held_up(monkeypatch):
    """A fit that folds until it is let go, and does as it is told."""
    under_way, go_on = threading.Event(), threading.Event()
    real = Fitting._count

    def count(self, attempt, folds):
        if folds:
            under_way.set()
            go_on.wait(60.0)
        return real(self, attempt, folds)

    monkeypatch.setattr(Fitting, "_count", count)
    return under_way, go_on


def test_one_at_a_time_and_cancelled(started, monkeypatch):
    engine = started(600)
    under_way, go_on = held_up(monkeypatch)
    fitting = Fitting(engine)
    fitting.begin(WANTED)
    assert under_way.wait(60.0)
    with pytest.raises(ConfigError, match="another one is under way; wait for it, or cancel it"):
        fitting.begin(WANTED)
    fitting.cancel()
    go_on.set()
    told = ended(fitting)
    assert (told.state, told.fitted, told.reason) == (CANCELLED, None, "")
    fitting.begin(WANTED)
    assert ended(fitting).state == DONE and fitting.latest.number == 2


def test_the_end_of_the_twin_ends_it(started, monkeypatch):
    engine = started(600)
    under_way, go_on = held_up(monkeypatch)
    fitting = Fitting(engine)
    fitting.begin(WANTED)
    assert under_way.wait(60.0)
    threading.Timer(0.05, go_on.set).start()
    fitting.stop()
    assert ended(fitting).state == CANCELLED


@pytest.mark.parametrize(
    ("n", "wanted", "reason"),
    [(0, WANTED, "no reading has come yet"), (600, ["Q.nothing"], "Q.nothing is no entry that can be fitted")],
)
def test_why_there_is_none(started, n, wanted, reason):
    fitting = Fitting(started(n))
    fitting.begin(wanted)
    told = ended(fitting)
    assert told.state == FAILED and reason in told.reason


def test_nothing_asked_for_is_refused(started):
    with pytest.raises(ConfigError, match="wanted is empty"):
        Fitting(started(0)).begin([])
