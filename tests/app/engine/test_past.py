"""The estimate and the status of an earlier moment are those of an engine that has had the events until then only."""

import numpy as np
import pytest

from app.cli.open_twin import live_source
from app.engine.commands import SetTuning
from app.engine.engine import Engine
from tests.app.scripted import Stepped, pull_all, random_walk, readings
from tests.skips import with_recording
from tests.support import SECOND
from tests.waiting import wait_for

N = 5000  # events: several permanent snapshots, and recent ones between them


def walk(n):
    """A random walk with a lasting offset from 300 s on, of which nothing is to be known before."""
    times, values = random_walk(n)
    return times, values + np.where(times > 300.0, 15.0, 0.0)


@pytest.mark.parametrize(("estimator", "at"), [("kf", 310.04), ("kf", 0.1), ("kf", 499.96), ("pf", 310.04)])
def test_the_estimate_of_a_moment_is_that_of_the_events_until_then(estimator, at):
    times, values = walk(N)
    all_of_it, until = Stepped(estimator=estimator), Stepped(estimator=estimator)
    all_of_it.put(readings(times, values))
    until.put(readings(times[times <= at], values[times <= at]))
    found, expected = all_of_it.engine.belief(round(at * SECOND)), until.engine.belief()
    assert found.t == expected.t
    for name in ("mean", "cov", "points"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert len(found.peaks) == len(expected.peaks)
    # The running fold has not moved.
    assert pull_all(all_of_it.engine).events.t[-1] == round(times[-1] * SECOND)


FIELDS = ("t", "health", "since", "sensors", "lost", "nis")


@pytest.mark.parametrize("at", [0.1, 299.0, 310.04, 480.0])
def test_the_status_of_a_moment_is_that_of_the_events_until_then(at):
    times, values = walk(N)
    all_of_it, until = Stepped(), Stepped()
    all_of_it.put(readings(times, values))
    until.put(readings(times[times <= at], values[times <= at]))
    found, expected = all_of_it.engine.status_at(round(at * SECOND)), until.status()
    assert_same_status(found, expected)
    assert bool(found.cause) == bool(expected.cause)
    assert found.estimator == all_of_it.status().estimator


def test_the_status_of_a_moment_of_a_large_field_is_that_of_its_rows(monkeypatch):
    """Without a fold of 1,617 cells it is the same as with one, folded from the snapshot before."""
    twin = with_recording("field_era5")
    engine = Engine(twin, live_source(twin, np.inf))
    engine.start()
    try:
        wait_for(lambda: engine.status().finished)
        # True states are 41 rows per measurement; the window ends with the last measurement, as that of the charts.
        assert engine.status().nis.nis == pytest.approx(pull_all(engine).track.nis_mean[-1], rel=1e-12)
        moments = [engine.span()[0] + hour * 3600 * SECOND for hour in (0, 5, 60, 200, 330)]
        with monkeypatch.context() as patch:
            patch.setattr(Engine, "fold_until", None)
            found = [engine.status_at(t) for t in moments]
        monkeypatch.setattr("app.engine.status.LARGE", twin.model.nx)
        expected = [engine.status_at(t) for t in moments]
    finally:
        engine.stop()
    assert len({status.health for status in found}) > 1
    for one, other in zip(found, expected, strict=True):
        assert_same_status(one, other)


def test_an_edit_changes_the_estimate_of_a_moment():
    stepped = Stepped().put(readings(*walk(N)))
    at = 310 * SECOND
    before = stepped.engine.belief(at)
    stepped.submit(SetTuning("R.winding", 100.0))
    after = stepped.engine.belief(at)
    assert after.t == before.t and after.cov[0, 0] > 2.0 * before.cov[0, 0]


def test_without_an_event_the_estimate_of_a_moment_is_the_present_one():
    empty = Stepped()
    assert_same_belief(empty.engine.belief(5), empty.engine.belief())
    assert empty.engine.status_at(5) == empty.engine.status()


def assert_same_status(found, expected):
    for name in FIELDS:
        one, other = getattr(found, name), getattr(expected, name)
        if name == "sensors":  # the text of an episode grows with it
            one, other = ({key: state for key, (state, _) in item.items()} for item in (one, other))
        np.testing.assert_equal(one, other, err_msg=name)


def assert_same_belief(one, other):
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.cov, other.cov)
