"""Every twin that ships opens, folds, and does what its opening text promises."""

from functools import lru_cache

import numpy as np
import pytest

from app.twin.twin import load_twin
from config.loader import TWINS, shipped
from estimators.diagnostics.episodes import episodes_of, judged_rows
from estimators.fold import fold
from estimators.log import READING, truth_of
from estimators.track import GATED, USED
from tests.skips import recorded
from tests.support import SECOND, as_log, read_all


@lru_cache(maxsize=1)
def folded(name):
    """Return the fold of a twin's own log, as the twin runs."""
    twin, log = recorded(name)
    fold = twin.fold(log, policy=twin.policy, expected=twin.expected)
    fold.advance()
    return fold


HUGE = ("thermal_field_large",)
"""Twins whose fold takes minutes; their first readings are folded."""


def test_a_million_cells_fold():
    for name in HUGE:
        twin = load_twin(name, overrides={"source.duration": "2"})
        source = twin.open_source(lambda key, text: None)
        log = as_log(read_all(source))
        tuning = twin.tuning.with_options({"members": 3, "radius": 0.5})
        track = fold(twin.estimator, twin.model, tuning, log)
        assert np.sum(track.verdict == USED) == 2
        assert np.isfinite(track.mean).all() and (track.std > 0).all()


@pytest.fixture(scope="module", params=[name for name in shipped() if name not in HUGE])
def run(request):
    """The tests of a twin follow each other, and share its fold."""
    return folded(request.param)


def test_it_opens_and_folds(run):
    events, track = run.log.events, run.track
    readings = events.kind == READING
    assert readings.sum() > 100
    used, gated = (np.sum(track.verdict[readings] == verdict) for verdict in (USED, GATED))
    assert used > 100 and gated < 0.1 * used, f"{used} readings were used and {gated} gated"
    # Of a mode one may be certain.
    uncertain = np.delete(track.std, run.model.mode, axis=1) if run.model.jump else track.std
    assert np.isfinite(track.mean).all() and (uncertain > 0).all() and (track.std >= 0).all()


def test_no_sensor_drops_out_in_the_first_minute(run, request):
    twin = load_twin(request.node.callspec.params["run"])
    injected = {fault.sensor for fault in twin.plan.scheduled}
    judged = judged_rows(run)
    minute = judged.events.t <= judged.events.t[0] + 60 * SECOND
    judged = judged._replace(events=judged.events.select(minute), track=judged.track.select(minute))
    causes = {item.cause for item in episodes_of(judged) if item.subject not in injected}
    assert not causes & {"silent", "never heard", "stale", "diverged"}


def test_the_motor_on_the_bus_finds_its_magnet():
    events, track = (fold := folded("motor_can")).log.events, fold.track
    assert (TWINS.parent / "logs" / "motor_can.blf").stat().st_size < 1_000_000
    seconds = (events.t - events.t[0]) * 1e-9
    for state, bound in ((0, 0.5), (1, 0.5), (2, 0.5)):
        rows, values = truth_of(events, state)
        assert np.abs(track.mean[rows, state] - values)[seconds[rows] > 20].max() < bound
    magnet, values = truth_of(events, 3)
    miss = np.abs(track.mean[magnet, 3] - values)
    assert miss[0] > 5 and miss[seconds[magnet] > 150].max() < 4
    assert track.std[magnet, 3][-1] < 3
