"""A fit beside a running twin: the same as the fit of its log alone, told, cancelled, refused."""

from types import SimpleNamespace

import pytest

from app.live.history_copy import COPY_EVENTS
from app.live.jobs import CANCELLED, DONE, FAILED
from app.live.runs.refits import Fitting
from estimators.errors import ConfigError
from estimators.fit.fit import fit
from estimators.fit.recording import Recording
from estimators.fold import Fold
from estimators.tuning import Tuning
from tests.app.scripted import MODEL, Stepped, random_walk, readings
from tests.support import as_log

FIRST = Tuning.of(MODEL)
WANTED = ["Q.rate", "R.winding"]


def walk(n):
    return readings(*random_walk(n, seed=3, step=0.05))


def fitted(engine, *request):
    """The attempt at the end of a fit."""
    fitting = Fitting(engine)
    fitting.begin(*request)
    engine.settle()
    assert fitting.latest.job.over
    return fitting.latest


def alone(n):
    log = as_log(walk(n))
    return fit("kf", FIRST, [Recording(log)], wanted=WANTED)


def test_a_fit_beside_the_twin_is_the_fit_of_its_log():
    # More than one chunk is copied.
    n = COPY_EVENTS + 900
    engine = Stepped(n, seed=3, step=0.05).engine
    found, expected = fitted(engine, WANTED), alone(n)
    assert (found.job.state, found.events, found.folds) == (DONE, n, expected.folds)
    assert found.seconds == pytest.approx(0.1 * (n - 1)) and found.job.elapsed > 0.0
    assert found.fitted.lines == expected.lines
    assert found.fitted.verdict == expected.verdict
    # Nothing was applied.
    assert engine.tuning is engine.twin.tuning and engine.revisions.runs[-1].number == 0


def test_the_last_events_are_folded_from_a_snapshot_on():
    found = fitted(Stepped(6000, seed=3, step=0.05).engine, WANTED, 3000)
    assert found.job.state == DONE and found.fitted.before.fitted.n + found.fitted.before.held_out.n == found.events
    # From the last snapshot at or before the event that was asked for.
    assert 3000 <= found.events < 6000


def test_a_data_sheet_bounds_it():
    engine = Stepped(1500, seed=3, step=0.05).engine
    free = alone(1500).lines[1].after
    # R was found below where the data sheet ends.
    bounds = (1.2 * free, FIRST.get("R.winding"))
    engine.twin.config.sensors = {"winding": SimpleNamespace(bounds=bounds, offset=None, scale=None)}
    line = fitted(engine, WANTED).fitted.lines[1]
    assert free < bounds[0] <= line.after <= bounds[1]


def test_one_at_a_time():
    engine = Stepped(600, seed=3, step=0.05).engine
    fitting = Fitting(engine)
    fitting.begin(WANTED)
    with pytest.raises(ConfigError, match="another one is under way; wait for it, or cancel it"):
        fitting.begin(WANTED)
    fitting.cancel()
    engine.settle()
    assert (fitting.latest.job.state, fitting.latest.fitted, fitting.latest.job.reason) == (CANCELLED, None, "")
    fitting.begin(WANTED)
    engine.settle()
    assert fitting.latest.job.state == DONE and fitting.latest.number == 2


def test_a_fit_that_is_cancelled_ends_after_its_current_folds(monkeypatch):
    engine = Stepped(600, seed=3, step=0.05).engine
    fitting = Fitting(engine)
    real = Fold.advance

    def advance(fold, *count):
        if fitting.latest is not None and fitting.latest.folds:
            fitting.cancel()
        return real(fold, *count)

    monkeypatch.setattr(Fold, "advance", advance)
    fitting.begin(WANTED)
    engine.settle()
    assert (fitting.latest.job.state, fitting.latest.fitted) == (CANCELLED, None)
    assert 0 < fitting.latest.folds < alone(600).folds


@pytest.mark.parametrize(
    ("n", "wanted", "reason"),
    [(0, WANTED, "no reading has come yet"), (600, ["Q.nothing"], "Q.nothing is no entry that can be fitted")],
)
def test_why_there_is_none(n, wanted, reason):
    found = fitted(Stepped(n, seed=3, step=0.05).engine, wanted)
    assert found.job.state == FAILED and reason in found.job.reason


def test_an_empty_request_is_rejected():
    with pytest.raises(ConfigError, match="wanted is empty"):
        Fitting(Stepped().engine).begin([])
