"""The fold is a pure function of its log: pieces, order of arrival, copies and cuts leave every bit as it was."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numba import njit

from estimators.errors import EstimatorError
from estimators.fold import Fold, fold
from estimators.log import INPUT, READING, RESET, TICK, TRUTH, Events, Log
from estimators.registry import ESTIMATORS
from estimators.snapshots import RECENT_EVENTS, Snapshot
from estimators.track import FAILED, GATED, HELD_OUT, MISSING, NONE, USED
from estimators.tuning import Tuning
from tests.estimators.linear_models import ROWS, random_linear, random_log
from tests.support import SECOND, as_log, assert_same, folded, log_of

MATRICES = random_linear(np.random.default_rng(1), 3, 2)
MODEL = MATRICES.model
PYTHON = ["filterpy-kf", "ekf-python"]
"""The other kind of fold: a filter in Python, and a compiled one in Python's loop (see `in_python`)."""

GAUSSIAN = [name for name, entry in ESTIMATORS.items() if entry.family == "Gaussian" and entry.applies(MODEL) is None]
NAMES = GAUSSIAN + PYTHON


def everything(rng, events):
    """Events, inputs, lost rows, and among them ticks, truths and a few resets."""
    readings = random_log(rng, MATRICES, events).events
    t = readings.t.copy()
    extra = []
    for kind, share in ((TICK, 5), (TRUTH, 5), (RESET, 80)):
        for _ in range(max(1, events // share)):
            at = int(rng.integers(t[0] + SECOND // 10, t[-1]))
            extra.append(Events.one(at, at, kind, 0, rng.normal(), MODEL.width))
    log = as_log(Events.concat([readings, *extra], MODEL.width))
    return Events(*(column.copy() for column in log.events))


def reading(t, sensor, values, width=MODEL.width):
    return Events.one(t, t, READING, sensor, values, width)


@cache
def in_python(name):
    """An entry whose compiled functions the Python loop calls, each with the context behind the view."""

    def behind(function):
        @njit(error_model="numpy")
        def call(context, rest):
            return function(context, *rest)  # it has no wrapper for Python

        return lambda view, *rest: call(view.context, rest)

    entry = ESTIMATORS[name]
    return replace(entry, name=f"{name}-python", interpreted=True, functions=tuple(map(behind, entry.functions)))


@pytest.fixture(params=NAMES)
def estimator(request, monkeypatch):
    if request.param == "ekf-python":
        monkeypatch.setitem(ESTIMATORS, request.param, in_python("ekf"))
    return request.param


FEW = pytest.mark.parametrize("estimator", ["kf", "iekf", "sr-ukf"], indirect=True)
"""For thousands of events: a covariance, one with a workspace of its own, and a factor."""


@pytest.mark.parametrize("seed", range(2))
def test_pieces_do_not_matter(estimator, seed):
    rng = np.random.default_rng(seed)
    events = everything(rng, 300)
    whole = fold(estimator, MODEL, Tuning.of(MODEL), as_log(events))
    log = Log(MODEL.width, capacity=1)
    growing = Fold(estimator, MODEL, Tuning.of(MODEL), log)
    at = 0
    while at < len(events):
        size = int(rng.choice([1, 2, 7, 63, 64, 65, 130]))
        log.extend(events.select(slice(at, at + size)))
        at += size
        growing.advance(int(rng.integers(1, 40)) if rng.random() < 0.5 else None)
    growing.advance()
    assert_same(growing.track, whole)


@FEW
def test_rewind_far_behind_the_recent_snapshots(estimator):
    events = random_log(np.random.default_rng(5), MATRICES, 2 * RECENT_EVENTS + 500).events
    log = as_log(events)
    growing = Fold(estimator, MODEL, Tuning.of(MODEL), log)
    while growing.advance(700):
        pass
    for index in (2 * RECENT_EVENTS, RECENT_EVENTS + 3, 1500, 1024, 1023, 5):
        growing.rewind(index)
        assert growing.n <= index
        growing.advance()
    assert_same(growing.track, fold(estimator, MODEL, Tuning.of(MODEL), log.copy()))


def test_a_fold_in_pieces_stops_no_more_often_than_one():
    """Snapshots are dense where late readings fall: at the end of the log, whatever is folded at once."""
    log = as_log(random_log(np.random.default_rng(5), MATRICES, 3 * RECENT_EVENTS).events)
    taken = []
    for size in (log.n, RECENT_EVENTS, 700):
        growing = Fold("kf", MODEL, Tuning.of(MODEL), log)
        remember, places = growing._remember, []
        growing._remember = lambda *given, of=growing, to=places, do=remember: (to.append(of.n), do(*given))
        while growing.advance(size):
            pass
        taken.append(places)
    assert taken[0] == taken[1] == taken[2]
    assert sum(place <= log.n - RECENT_EVENTS for place in taken[0]) == 2 * RECENT_EVENTS // 1024


def test_snapshots_of_one_call_are_those_of_single_events(estimator):
    """A call takes up to 16 snapshots. Each has clock, inputs, filter, detectors, screen and gates event by event."""
    log = as_log(everything(np.random.default_rng(7), 700))
    at_once, single = (Fold(estimator, MODEL, Tuning.of(MODEL), log) for _ in range(2))
    at_once.advance()
    while single.advance(1):
        pass
    places = at_once.snapshots.places
    assert places == single.snapshots.places and len(places) > 8
    for at in places:
        for name, mine, its in zip(Snapshot._fields, at_once.snapshots[at], single.snapshots[at], strict=True):
            np.testing.assert_array_equal(mine, its, f"{name} before event {at}")


@pytest.mark.parametrize("size", [1, 50, None], ids=["event by event", "in pieces", "at once"])
def test_snapshots_are_the_denser_the_later(size):
    """64 events apart in the last 1,024, 256 in the last 4,096, 1,024 before; also while the log grows."""
    events = random_log(np.random.default_rng(5), MATRICES, 3 * RECENT_EVENTS).events
    log = as_log(events.select(slice(0, 0)))
    growing = Fold("kf", MODEL, Tuning.of(MODEL), log)
    for start in range(0, 3 * RECENT_EVENTS, size or 3 * RECENT_EVENTS):
        log.extend(events.select(slice(start, start + (size or 3 * RECENT_EVENTS))))
        growing.advance()
    behind = log.n - np.arange(log.n + 1)
    at = np.arange(log.n + 1)
    wanted = (at % 1024 == 0) | (at % 256 == 0) & (behind < 4096) | (at % 64 == 0) & (behind < 1024)
    exact = wanted | (at % 256 == 0) & (behind == 4096) | (at % 64 == 0) & (behind == 1024)
    assert set(at[wanted]) <= set(growing.snapshots.places) <= set(at[exact])


@pytest.mark.parametrize("late", [False, True])
def test_follow_a_log_that_grew_meanwhile(estimator, late):
    """A refold on a copy, with another tuning, joins the live log: as if it had folded that from the start."""
    events = everything(np.random.default_rng(6), 1500)
    tuning = Tuning.of(MODEL).set("R.first", 3.0)
    log = as_log(events.select(slice(0, 900)))
    beside = folded(estimator, MODEL, log.copy(), tuning, stop=500)
    log.extend(events.select(slice(900, None)))
    changed = None
    if late:
        changed = log.first + log.extend(reading(int(events.t[450]) + 1, 0, [2.0]))[0]
    beside.advance()
    beside.follow(log, changed)
    beside.advance()
    assert_same(beside.track, fold(estimator, MODEL, tuning, log.copy()))


@FEW
def test_drop_front_and_base_at(estimator):
    events = everything(np.random.default_rng(7), 6000)
    log = as_log(events)
    tuning = Tuning.of(MODEL)
    whole = fold(estimator, MODEL, tuning, log.copy())
    growing = folded(estimator, MODEL, log, tuning, stop=4000)
    at, base = growing.base_at(1500)
    assert 0 < at <= 1500
    fresh_log = as_log(events.select(slice(at, None)))
    fresh_log.first = at
    fresh = Fold(estimator, MODEL, tuning, fresh_log, base=base)
    growing.drop_front(at)
    log.drop_front(at)
    assert log.first == at
    for one in (growing, fresh):
        one.advance()
        assert one.n == len(events) - at
        # What does not look back over the cut: everything but the windowed columns of the fresh one.
        for name in ("mean", "std", "cross", "innovation", "innovation_std", "nis", "log_likelihood", "dof", "verdict"):
            np.testing.assert_array_equal(getattr(one.track, name), getattr(whole, name)[at:], err_msg=name)
    assert_same(growing.track, whole.select(slice(at, None)))
    with pytest.raises(EstimatorError, match="no snapshot"):
        growing.drop_front(1)


KEEPING = {
    "pf": {"particles": 60.0}, "pf-reg": {"particles": 60.0}, "apf": {"particles": 60.0}, "enkf": {"members": 9.0},
    "etkf": {"members": 9.0, "rotation": 1.0}, "ekf": {"adapt": 1.0}, "sr-ukf": {}, "filterpy-enkf": {"members": 9.0},
}  # fmt: skip
"""Filters whose mean and covariance are not all that they know."""
ALONE = ("mean", "std", "cross", "innovation", "innovation_std", "nis", "log_likelihood", "dof", "verdict")
"""Columns that do not look back over a cut."""


@pytest.mark.parametrize("name", KEEPING)
def test_the_same_filter_goes_on_from_a_cut_with_all_it_knew(name):
    events = everything(np.random.default_rng(9), 1500)
    tuning = Tuning.of(MODEL).with_options(KEEPING[name])
    whole = folded(name, MODEL, as_log(events), tuning)
    at, base = whole.base_at(1200)
    assert 0 < at <= 1200 and base.estimator == name

    def rest(estimator, tuning):
        log = as_log(events.select(slice(at, None)))
        log.first = at
        fold = Fold(estimator, MODEL, tuning, log, base=base)
        started = fold.moments()
        fold.advance()
        return started, fold.track

    _, again = rest(name, tuning)
    for column in ALONE:
        np.testing.assert_array_equal(getattr(again, column), getattr(whole.track, column)[at:], err_msg=column)
    # Another tuning goes on from there too; another filter, or another size, from the moments.
    (mean, cov), _ = rest(name, tuning.set("R.first", 3.0))
    np.testing.assert_array_equal(mean, base.mean)
    np.testing.assert_array_equal(cov, base.cov)
    for other, options in (("ukf", {}), (name, {key: 2 * value for key, value in KEEPING[name].items()})):
        if "rotation" not in options:
            (mean, _), _ = rest(other, Tuning.of(MODEL).with_options(options))
            np.testing.assert_allclose(mean, base.mean, atol=5.0 * np.sqrt(np.diag(base.cov).max()))


@FEW
def test_follow_over_a_cut(estimator):
    """The live log forgot its oldest events while a copy was refolded."""
    events = everything(np.random.default_rng(8), 5000)
    log = as_log(events.select(slice(0, 4000)))
    tuning = Tuning.of(MODEL)
    live = folded(estimator, MODEL, log, tuning)
    beside = folded(estimator, MODEL, log.copy(), tuning)
    at, _ = live.base_at(1100)
    live.drop_front(at)
    log.drop_front(at)
    log.extend(events.select(slice(4000, None)))
    beside.follow(log, None)
    beside.advance()
    assert_same(beside.track, fold(estimator, MODEL, tuning, as_log(events)).select(slice(at, None)))
    with pytest.raises(EstimatorError, match="another"):
        beside.follow(as_log(events), None)


def test_queries_never_change_the_estimate(estimator):
    rng = np.random.default_rng(9)
    events = random_log(rng, MATRICES, 200).events
    bare = fold(estimator, MODEL, Tuning.of(MODEL), as_log(events))
    queries = [
        Events.one(t, t, kind, 0, 1e6, MODEL.width)
        for kind in (TICK, TRUTH)
        for t in rng.integers(events.t[0] + 1, events.t[-1] + 10 * SECOND, 150)
    ]
    log = as_log(Events.concat([events, *queries], MODEL.width))
    track = fold(estimator, MODEL, Tuning.of(MODEL), log)
    query = np.isin(log.events.kind, (TICK, TRUTH))
    assert query.sum() == 300
    for name in ("mean", "std", "innovation", "innovation_std", "nis", "log_likelihood", "dof", "verdict"):
        np.testing.assert_array_equal(getattr(track.select(~query), name), getattr(bare, name), err_msg=name)
    assert np.all(track.verdict[query] == NONE)
    assert np.all(np.isnan(track.nis[query]))


def test_a_query_says_what_a_missing_reading_says(estimator):
    """Prediction to t is prediction to t, asked in either way."""
    events = random_log(np.random.default_rng(10), MATRICES, 40).events
    t = int(events.t[-1]) + SECOND // 3
    asked = as_log(Events.concat([events, Events.one(t, t, TICK, 0, (), MODEL.width)], MODEL.width))
    missed = as_log(Events.concat([events, reading(t, 2, np.full(3, np.nan))], MODEL.width))
    a, b = (fold(estimator, MODEL, Tuning.of(MODEL), log) for log in (asked, missed))
    np.testing.assert_array_equal(a.mean[-1], b.mean[-1])
    np.testing.assert_array_equal(a.std[-1], b.std[-1])
    assert b.verdict[-1] == MISSING
    assert np.all(b.std[-1] != b.std[-2])


def test_reset_is_a_fresh_start(estimator):
    rng = np.random.default_rng(11)
    events = random_log(rng, MATRICES, 120).events
    events = events.select(events.kind == READING)
    t = int(events.t[60]) + 7
    log = as_log(Events.concat([events, Events.one(t, t, RESET, 0, (), MODEL.width)], MODEL.width))
    at = int(np.flatnonzero(log.events.kind == RESET)[0])
    track = fold(estimator, MODEL, Tuning.of(MODEL), log)
    # A tick anchors the prior of the fresh start at the time of the reset.
    after = as_log(
        Events.concat([Events.one(t, t, TICK, 0, (), MODEL.width), log.events.select(slice(at + 1, None))], 3)
    )
    fresh = fold(estimator, MODEL, Tuning.of(MODEL), after)
    for name in ("mean", "std", "innovation", "nis", "log_likelihood", "verdict"):
        np.testing.assert_array_equal(getattr(track, name)[at:], getattr(fresh, name), err_msg=name)
    np.testing.assert_array_equal(track.mean[at], MATRICES.mean)


def test_dt_of_zero_predicts_nothing(estimator):
    log = log_of(3, (3, READING, 1.0), (3, READING, [np.nan] * 2, 1), (3, READING, np.nan))
    track = fold(estimator, MODEL, Tuning.of(MODEL), log)
    np.testing.assert_array_equal(track.mean[1], track.mean[0])
    np.testing.assert_array_equal(track.std[2], track.std[0])
    # The first reading meets the prior as it is: nothing was predicted before the first event.
    H, R = MATRICES.H[0], MATRICES.R[0]
    S = float(H[0] @ np.diag(MATRICES.std**2) @ H[0] + R[0])
    np.testing.assert_allclose(track.innovation_std[0, 0], np.sqrt(S), rtol=1e-14)


def test_an_enormous_reading_does_not_raise(estimator):
    """1e300 overflows the NIS: the reading fails or is gated; nothing raises, and the estimate stays a number."""
    log = log_of(3, (1, READING, 1.0), (2, READING, 1e300))
    assert fold(estimator, MODEL, Tuning.of(MODEL).set("gate", 0.999), log).verdict[1] == GATED
    track = fold(estimator, MODEL, Tuning.of(MODEL), log)
    assert track.nis[1] == np.inf
    assert track.verdict[1] == FAILED
    assert np.all(np.isfinite(track.mean))


def test_gate_refuses_and_leaves_the_prediction(estimator):
    tuning = Tuning.of(MODEL).set("gate", 0.99)
    both, missed = (
        log_of(3, (1, READING, [0.1, 0.2], 1), (2, READING, y, 1)) for y in ([80.0, -90.0], [np.nan, np.nan])
    )
    gated, missing = (fold(estimator, MODEL, tuning, log) for log in (both, missed))
    assert gated.verdict[1] == GATED
    np.testing.assert_array_equal(gated.mean[1], missing.mean[1])
    np.testing.assert_array_equal(gated.std[1], missing.std[1])
    assert np.isfinite(gated.nis[1])
    assert fold(estimator, MODEL, Tuning.of(MODEL), both).verdict[1] == USED


def test_gate_is_the_chi_square_quantile_of_the_rows_that_came(estimator):
    """A reading just inside and one just outside: 6.6349 for one row, 9.2103 for two, at 0.99 (tables)."""
    H, S0 = MATRICES.H[1], np.diag(MATRICES.std**2)
    S = H @ S0 @ H.T + np.diag(MATRICES.R[1])
    expected = H @ MATRICES.mean + MATRICES.D[1] @ MATRICES.u
    for rows, quantile in ((1, 6.634897), (2, 9.210340)):
        direction = np.array([1.0, 0.0]) if rows == 1 else np.array([0.6, -0.8])
        size = (1 / S[0, 0]) if rows == 1 else direction @ np.linalg.solve(S, direction)
        for factor, verdict in ((0.9999, USED), (1.0001, GATED)):
            y = expected + direction * np.sqrt(quantile * factor / size)
            y = np.array([y[0], np.nan]) if rows == 1 else y
            track = fold(estimator, MODEL, Tuning.of(MODEL).set("gate", 0.99), as_log(reading(SECOND, 1, y)))
            assert track.verdict[0] == verdict, (rows, factor)


def test_an_unused_sensor_is_held_out_and_a_gated_one_stays_held_out(estimator):
    log = as_log(reading(SECOND, 0, [1e3]))
    tuning = Tuning.of(MODEL).set("gate", 0.99).set("use.first", False)
    assert fold(estimator, MODEL, tuning, log).verdict[0] == HELD_OUT


@pytest.mark.parametrize("kinds", [(TICK,), (RESET, TICK)])
def test_inputs_that_are_nan_stay_and_a_reset_keeps_them(estimator, kinds):
    """Inputs are facts about the asset, not beliefs."""
    later = ((k, kind, ()) for k, kind in enumerate(kinds, start=1))
    growing = folded(estimator, MODEL, log_of(MODEL.width, (0, INPUT, [5.0, np.nan]), *later))
    u = np.array([5.0, MATRICES.u[1]])
    np.testing.assert_array_equal(growing.u, u)
    expected = MATRICES.mean + MATRICES.A @ MATRICES.mean + MATRICES.B @ u
    # One step of a linear map: a few roundings of numbers of order 10.
    np.testing.assert_allclose(growing.track.mean[-1], expected, rtol=1e-13, atol=1e-13)


@FEW
def test_covariance_stays_symmetric_and_positive(estimator):
    """Thousands of precise readings: where P - K S Kᵀ in plain form would lose its sign."""
    rng = np.random.default_rng(13)
    tuning = Tuning.of(MODEL)
    for key in [item.key for item in tuning.items() if item.key.startswith("R.")]:
        tuning = tuning.set(key, 1e-6)
    log = log_of(MODEL.width, *((k / 100, READING, rng.normal(0, 1, ROWS[k % 3]), k % 3) for k in range(2000)))
    growing = Fold(estimator, MODEL, tuning, log)
    while growing.advance(97):
        _, P = growing.moments()
        np.testing.assert_array_equal(P, P.T)
        # Rounding of P is 1e-16 of its largest entry: an eigenvalue may be that much below zero, no more.
        assert np.linalg.eigvalsh(P).min() > -1e-14 * np.abs(P).max()
    assert not np.any(growing.track.verdict == FAILED)
