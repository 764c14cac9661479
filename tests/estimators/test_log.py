"""The log: order of time, whatever the order and pieces of arrival; nothing lost, nothing twice.

The events here are numbered by their values, so that at equal times they keep the order of arrival (see test_order).
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.fold import Fold, fold
from estimators.log import INPUT, READING, RESET, TICK, TRUTH, Events, Log, truth_of
from estimators.registry import ESTIMATORS
from estimators.track import Track
from estimators.tuning import Tuning
from tests.estimators.linear_models import ROWS, random_linear
from tests.support import SECOND, arrive, as_log, assert_same, folded


def any_seed(test):
    """The test for thirty seeds of its random events, drawn by hypothesis."""
    return settings(max_examples=30, deadline=None, derandomize=True)(given(seed=st.integers(0, 2**32 - 1))(test))


def batch(times, first=0, kind=READING, width=2):
    """Events whose value[0] numbers them."""
    t = np.asarray(times, np.int64)
    value = np.full((t.size, width), np.nan)
    value[:, 0] = first + np.arange(t.size)
    return Events.alike(kind, t, value)._replace(arrival=t + 5)


def pieces(rng, events):
    at = 0
    while at < len(events):
        size = int(rng.integers(1, 12))
        yield events.select(slice(at, at + size))
        at += size


def same(a, b):
    for left, right in zip(a, b, strict=True):
        np.testing.assert_array_equal(left, right)


def lately(rng, n):
    """Times that mostly grow, some of them late, many of them equal."""
    t = np.cumsum(rng.integers(0, 4, n)) * SECOND
    late = rng.random(n) < 0.3
    return t - late * rng.integers(0, 30, n) * SECOND


@any_seed
def test_stale_is_judged_event_by_event(seed):
    """An event is stale against the newest that arrived before it, not against its batch."""
    rng = np.random.default_rng(seed)
    events = batch(lately(rng, 200))
    horizon = 10 * SECOND
    newest, keep = -np.inf, []
    for i in range(200):  # the rule, literally
        keep.append(events.t[i] >= newest - horizon)
        newest = max(newest, events.t[i])
    assert 5 < 200 - sum(keep) < 100
    kept = events.select(np.array(keep))
    expected = kept.select(np.argsort(kept.t, kind="stable"))
    for _ in range(3):
        log, stale = Log(2), 0
        for piece in pieces(rng, events):
            stale += log.extend(piece, horizon)[1]
        assert stale == 200 - sum(keep)
        same(log.events, expected)


def test_a_tick_makes_nothing_late():
    """A tick at the wall clock, ahead of all readings, must not turn the readings that follow into stale ones."""
    log = Log(2)
    log.extend(batch([0]))
    log.extend(batch([100 * SECOND], kind=TICK))
    assert log.extend(batch([SECOND]), horizon=10 * SECOND) == (1, 0)
    assert list(log.events.t) == [0, SECOND, 100 * SECOND]


def test_ticks_before_anything_was_said():
    log = Log(2)
    assert log.extend(batch([5], kind=TICK), horizon=10) == (0, 0)
    assert log.extend(batch([-100]), horizon=10) == (0, 0)


def test_drop_front_keeps_absolute_indices():
    log = Log(2, capacity=4)
    log.extend(batch(np.arange(10)))
    log.drop_front(7)
    assert (log.first, log.n) == (7, 3)
    assert list(log.events.value[:, 0]) == [7, 8, 9]
    log.extend(batch([8], first=50))
    assert list(log.events.value[:, 0]) == [7, 8, 50, 9]
    log.drop_front(4)
    assert (log.first, log.n) == (11, 0)


def test_a_copy_is_its_own():
    log = Log(2)
    log.extend(batch([10, 20, 30]))
    log.drop_front(1)
    twin = log.copy()
    log.extend(batch([25, 40], first=9))
    assert (twin.n, twin.first, twin.newest) == (2, 1, 30)
    assert list(twin.events.t) == [20, 30]
    # It judges staleness as the log would have.
    assert twin.extend(batch([15]), horizon=10) == (2, 1)


def test_one_and_concat():
    one = Events.one(7, 8, READING, 3, [1.5], 3)
    np.testing.assert_array_equal(one.value, [[1.5, np.nan, np.nan]])
    assert (one.t[0], one.arrival[0], one.kind[0], one.channel[0], len(one)) == (7, 8, READING, 3, 1)
    both = Events.concat([one, one], 3)
    assert len(both) == 2
    assert len(Events.concat([], 3)) == 0
    assert Events.concat([], 3).value.shape == (0, 3)


def test_fewer_columns_are_filled_up_not_repeated():
    """A recording of old holds one true value an event; in a wider log it must not become that of its neighbour."""
    old = Events.one(1, 1, TRUTH, 0, 7.0, 1)
    log = Log(3)
    log.extend(old)
    log.extend(Events.concat([old, Events.one(2, 2, TRUTH, 1, 8.0, 3)], 3))
    expected = [[7.0, np.nan, np.nan], [7.0, np.nan, np.nan], [8.0, np.nan, np.nan]]
    np.testing.assert_array_equal(log.events.value, expected)
    assert old.widened(1) is old and log.events.widened(2).value.shape == (3, 3)


@any_seed
def test_truth_of_is_its_definition(seed):
    """Event by event: values from the state `channel` on, some NaN, among readings and ticks that must not count."""
    rng = np.random.default_rng(seed)
    n, width, states = 1000, 4, 11
    events = Events(
        np.arange(n),
        np.arange(n),
        rng.choice([READING, TRUTH, TICK], n).astype(np.int8),
        rng.integers(0, states, n).astype(np.int32),
        np.where(rng.random((n, width)) < 0.3, np.nan, rng.normal(size=(n, width))),
    )
    known = {j: ([], []) for j in range(states + width)}
    for i in range(n):
        for k in range(width):
            if events.kind[i] == TRUTH and np.isfinite(events.value[i, k]):
                known[events.channel[i] + k][0].append(i)
                known[events.channel[i] + k][1].append(events.value[i, k])
    for j, (rows, values) in known.items():
        got = truth_of(events, j)
        assert got[0].tolist() == rows and got[1].tolist() == values
    assert all(len(rows) > 5 for rows, _ in list(known.values())[:states])
    assert truth_of(Events.empty(2), 0)[1].size == 0


def test_columns_can_be_replaced_though_len_counts_events():
    events = Events.one(1, 2, READING, 0, [1.0], 2)
    changed = events._replace(t=np.array([5]))
    assert changed.t.tolist() == [5] and changed.arrival is events.arrival and len(changed) == 1
    track = Track.allocate(7, 2, 1, 1)
    assert len(track._replace(nis=np.zeros(3))) == 3


MODEL = random_linear(np.random.default_rng(1), 3, 2).model
WIDTH = MODEL.width
RANK = {INPUT: 0, READING: 1, TRUTH: 2, TICK: 3, RESET: 4}
FILTERS = {
    "kf": {}, "ekf": {"adapt": "R"}, "iekf": {"inflation": 1.5}, "ukf": {"robust": "huber"}, "ckf": {"adapt": "Q"},
    "sr-kf": {}, "sr-ekf": {}, "sr-ukf": {"adapt": "Q", "robust": 2.0}, "pf": {"particles": 50},
    "apf": {"particles": 50}, "rbpf": {"particles": 20}, "enkf": {"members": 8}, "ensrf": {"members": 8},
    "filterpy-kf": {},
}  # fmt: skip


def crowded(rng, times=12, each=9):
    """Many events of every kind at few times, some of them alike but for their values, some alike altogether."""
    kinds = rng.choice([READING, READING, READING, INPUT, INPUT, TRUTH, TICK, RESET], times * each)
    events = []
    for i, kind in enumerate(kinds):
        t = int(rng.integers(1, times)) * SECOND
        channel = int(rng.integers(0, 3)) if kind in (READING, TRUTH) else 0
        room = {READING: ROWS[channel], INPUT: MODEL.nu, TRUTH: MODEL.nx - channel}.get(int(kind), 0)
        values = np.where(rng.random(room) < 0.3, np.nan, rng.integers(-2, 3, room))
        events.append(Events.one(t, i, int(kind), channel, values, WIDTH))
    return Events.concat(events, WIDTH)


def literally(events):
    """The order as order.py states it, by Python's sort of tuples; a missing value is above every number."""

    def key(i):
        values = [np.inf if np.isnan(v) else v for v in events.value[i]]
        return int(events.t[i]), RANK[int(events.kind[i])], int(events.channel[i]), *values

    return sorted(range(len(events)), key=key)


def same_events(a, b):
    """All that a fold reads; of events that are alike the stamps of arrival may change places."""
    for name in ("t", "kind", "channel", "value"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def shuffled(rng, events):
    """The same events in another order and other pieces."""
    order = rng.permutation(len(events))
    return [events.select(part) for part in np.array_split(order, int(rng.integers(1, len(events))))]


@any_seed
def test_any_order_of_arrival_gives_the_order_as_it_is_stated(seed):
    rng = np.random.default_rng(seed)
    events = crowded(rng)
    expected = events.select(np.array(literally(events)))
    log = Log.of(MODEL, capacity=1)
    for part in shuffled(rng, events):
        before = Events(*(column.copy() for column in log.events))
        changed, stale = log.extend(part)
        assert stale == 0
        same_events(log.events.select(slice(0, changed)), before.select(slice(0, changed)))
    same_events(log.events, expected)
    assert log.capacity < 4 * log.n


@pytest.mark.parametrize("name", FILTERS)
def test_any_order_of_arrival_gives_the_same_bits(name):
    """At once or late, with rewinds: pf differed by 0.9 of its deviation."""
    assert ESTIMATORS[name].applies(MODEL) is None
    rng = np.random.default_rng(7)
    tuning = Tuning.of(MODEL).with_options(FILTERS[name])
    for _ in range(6):
        events = crowded(rng)
        whole = as_log(events)
        expected = fold(name, MODEL, tuning, whole)
        log = Log.of(MODEL, capacity=1)
        growing = Fold(name, MODEL, tuning, log)
        assert arrive(growing, shuffled(rng, events)) > 0 or len(log.t) == 1
        assert_same(growing.track, expected)


def test_inputs_hold_for_the_readings_of_their_time_and_a_reset_comes_last():
    """What is read with u at t is predicted with that u; queries see the reading; the reset undoes it all."""
    events = [
        Events.one(SECOND, 0, RESET, 0, (), WIDTH),
        Events.one(SECOND, 0, TICK, 0, (), WIDTH),
        Events.one(SECOND, 0, READING, 1, [5.0, 5.0], WIDTH),
        Events.one(SECOND, 0, INPUT, 0, [3.0, 4.0], WIDTH),
    ]
    log = as_log(Events.concat(events, WIDTH))
    track = fold("ekf", MODEL, Tuning.of(MODEL), log)
    assert log.events.kind.tolist() == [INPUT, READING, TICK, RESET]
    np.testing.assert_array_equal(track.mean[2], track.mean[1])
    np.testing.assert_array_equal(track.mean[3], MODEL.prior_mean)
    # The innovation is y - H m - D u, with the input of that very time.
    without = as_log(Events.concat(events[2:3], WIDTH))
    u = MODEL.default_inputs
    D = random_linear(np.random.default_rng(1), 3, 2).D[1]
    plain = fold("ekf", MODEL, Tuning.of(MODEL), without)
    expected = plain.innovation[0, :2] - D @ (np.array([3.0, 4.0]) - u)
    np.testing.assert_allclose(track.innovation[1, :2], expected, rtol=1e-12)


def test_of_two_inputs_at_one_time_the_larger_holds():
    one, two = (Events.one(SECOND, 0, INPUT, 0, [value, np.nan], WIDTH) for value in (1.0, 2.0))
    for order in ([one, two], [two, one]):
        log = Log.of(MODEL)
        for event in order:
            log.extend(event)
        growing = folded("ekf", MODEL, log)
        assert growing.u[0] == 2.0


def test_appending_in_order_changes_nothing_before():
    """Events of one time that come one by one, as sensors speak: no rewind."""
    log = Log.of(MODEL)
    for k, (kind, channel) in enumerate([(INPUT, 0), (READING, 0), (READING, 1), (TRUTH, 0), (TICK, 0), (RESET, 0)]):
        assert log.extend(Events.one(SECOND, k, kind, channel, 1.0, WIDTH)) == (k, 0)
    assert log.extend(Events.one(SECOND, 9, READING, 1, 2.0, WIDTH)) == (3, 0)
    assert log.extend(Events.empty(WIDTH)) == (7, 0)


@pytest.mark.parametrize("horizon", [None, 10_000 * SECOND])
def test_what_is_older_than_all_that_is_kept_is_stale(horizon):
    """It was folded on the base, with the clock set back to its own time."""
    log = as_log(Events.concat([Events.one(k * SECOND, 0, READING, 0, 0.1, WIDTH) for k in range(2000)], WIDTH))
    growing = folded("kf", MODEL, log)
    at, base = growing.base_at(1500)
    growing.drop_front(at)
    log.drop_front(at)
    early = [Events.one(k * SECOND, 0, READING, 0, 99.0, WIDTH) for k in (5, at - 2, at - 1, at)]
    before = growing.track.copy()
    changed, stale = log.extend(Events.concat(early, WIDTH), horizon)
    # Of the dropped, the last was at `at - 1` seconds; one at that time can still be folded after it.
    assert (changed, stale) == (0, 2) and log.t[0] == (at - 1) * SECOND
    growing.rewind(changed)
    growing.advance(1)
    assert growing.clock == base.clock == (at - 1) * SECOND
    assert len(before) + 2 == log.n


def test_before_the_start_is_stale():
    log = Log.of(MODEL, start=10.0)
    batch = Events.concat([Events.one(k * SECOND, 0, READING, 0, 0.1, WIDTH) for k in (9, 10, 11)], WIDTH)
    assert log.extend(batch) == (0, 1)
    assert log.copy().extend(batch) == (1, 1)


def test_measurements_before_the_first_with_a_variance_have_none():
    log = Log(1, capacity=8)
    log.extend(Events.one(1, 1, READING, 0, 5.0, 1))
    log.extend(Events.one(2, 2, READING, 0, 6.0, 1)._replace(value=np.array([[6.0, 0.25]])))
    np.testing.assert_array_equal(log.events.value, [[5.0, np.nan], [6.0, 0.25]])
