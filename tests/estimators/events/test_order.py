"""Order of events: any order of arrival gives the same log and the same bits, at equal times too."""

import numpy as np
import pytest

from estimators.fold import Fold, fold
from estimators.log import INPUT, READING, RESET, TICK, TRUTH, Events, Log
from estimators.registry import ESTIMATORS
from estimators.tuning import Tuning
from tests.estimators.linear_models import ROWS, random_linear
from tests.support import SECOND, assert_same

MODEL = random_linear(np.random.default_rng(1), 3, 2).model
WIDTH = MODEL.width
RANK = {INPUT: 0, READING: 1, TRUTH: 2, TICK: 3, RESET: 4}
FILTERS = {
    "kf": {}, "ekf": {"adapt": "R"}, "ukf": {"robust": "huber"}, "sr-ekf": {}, "pf": {"particles": 50},
    "apf": {"particles": 50}, "rbpf": {"particles": 20}, "enkf": {"members": 8}, "ensrf": {"members": 8},
    "filterpy-ukf": {},
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


@pytest.mark.parametrize("seed", range(30))
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


@pytest.mark.parametrize("name", FILTERS)
def test_any_order_of_arrival_gives_the_same_bits(name):
    """At once or late, with rewinds: pf differed by 0.9 of its deviation."""
    assert ESTIMATORS[name].applies(MODEL) is None
    rng = np.random.default_rng(7)
    tuning = Tuning.of(MODEL).with_options(FILTERS[name])
    for _ in range(6):
        events = crowded(rng)
        whole = Log.of(MODEL)
        whole.extend(events)
        expected = fold(name, MODEL, tuning, whole)
        log = Log.of(MODEL, capacity=1)
        growing = Fold(name, MODEL, tuning, log)
        rewound = 0
        for part in shuffled(rng, events):
            changed, _ = log.extend(part)
            rewound += changed < growing.n
            growing.rewind(changed)
            growing.advance()
        assert rewound > 0 or len(log.t) == 1
        assert_same(growing.track, expected)


def test_inputs_hold_for_the_readings_of_their_time_and_a_reset_comes_last():
    """What is read with u at t is predicted with that u; queries see the reading; the reset undoes it all."""
    events = [
        Events.one(SECOND, 0, RESET, 0, (), WIDTH),
        Events.one(SECOND, 0, TICK, 0, (), WIDTH),
        Events.one(SECOND, 0, READING, 1, [5.0, 5.0], WIDTH),
        Events.one(SECOND, 0, INPUT, 0, [3.0, 4.0], WIDTH),
    ]
    log = Log.of(MODEL)
    log.extend(Events.concat(events, WIDTH))
    track = fold("ekf", MODEL, Tuning.of(MODEL), log)
    assert log.events.kind.tolist() == [INPUT, READING, TICK, RESET]
    np.testing.assert_array_equal(track.mean[2], track.mean[1])
    np.testing.assert_array_equal(track.mean[3], MODEL.prior_mean)
    # The innovation is y - H m - D u, with the input of that very time.
    without = Log.of(MODEL)
    without.extend(Events.concat(events[2:3], WIDTH))
    u = np.array([item.default for item in MODEL.inputs])
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
        growing = Fold("ekf", MODEL, Tuning.of(MODEL), log)
        growing.advance()
        assert growing.u[0] == 2.0


def test_appending_in_order_changes_nothing_before():
    """Events of one time that come one by one, as sensors speak: no rewind."""
    log = Log.of(MODEL)
    for k, (kind, channel) in enumerate([(INPUT, 0), (READING, 0), (READING, 1), (TRUTH, 0), (TICK, 0), (RESET, 0)]):
        assert log.extend(Events.one(SECOND, k, kind, channel, 1.0, WIDTH)) == (k, 0)
    assert log.extend(Events.one(SECOND, 9, READING, 1, 2.0, WIDTH)) == (3, 0)


@pytest.mark.parametrize("horizon", [None, 10_000 * SECOND])
def test_what_is_older_than_all_that_is_kept_is_stale(horizon):
    """It was folded on the base, with the clock set back to its own time."""
    log = Log.of(MODEL)
    log.extend(Events.concat([Events.one(k * SECOND, 0, READING, 0, 0.1, WIDTH) for k in range(2000)], WIDTH))
    growing = Fold("kf", MODEL, Tuning.of(MODEL), log)
    growing.advance()
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
