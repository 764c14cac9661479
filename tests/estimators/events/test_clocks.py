"""The guard of times: lone wrong stamps go, clocks that were set go on, gaps and late readings stay as they are.

The truth of each stream is made first and then spoiled, so what must come out is known without the guard.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.events.clocks import ClockGuard
from estimators.log import INPUT, READING, TICK, TRUTH, Events, Log
from tests.support import SECOND

HORIZON = 2 * SECOND
HOUR = 3600.0


def events(t, arrival=None, kind=READING, channel=0):
    """Events whose value is their number, so that each can be found again."""
    t = np.round(np.asarray(t, float) * SECOND).astype(np.int64)
    arrival = t.copy() if arrival is None else np.round(np.asarray(arrival, float) * SECOND).astype(np.int64)
    return Events.alike(kind, t, np.arange(t.size, dtype=float), channel)._replace(arrival=arrival)


class Outcome:
    """A stream through guard and log, cut before the events at `cuts`."""

    def __init__(self, stream, cuts=(), horizon=HORIZON, sensors=2, utc=False):
        guard, self.log = ClockGuard(sensors, horizon, utc), Log(1)
        self.stale, self.refused, self.moved = 0, [], []
        edges = [0, *sorted(cuts), len(stream)]
        passed = [guard.take(stream.select(slice(a, b))) for a, b in zip(edges, edges[1:], strict=False)]
        for part in (*passed, guard.finish()):
            self.stale += self.log.extend(part.events, horizon, part.settled)[1]
            self.refused += part.refused
            self.moved += part.moved
        assert guard.held == 0
        assert self.log.n + self.stale + len(self.refused) == len(stream)

    @property
    def numbers(self):
        return self.log.events.value[:, 0]

    @property
    def seconds(self):
        return self.log.events.t / SECOND

    def told(self):
        log = self.log
        return self.stale, self.refused, self.moved, *(column[: log.n].tolist() for column in log._columns()[:4])


T = np.arange(2000.0)
DELAY = 0.01


@pytest.mark.parametrize("arrivals", [False, True])
@pytest.mark.parametrize("ahead", [HOUR, 60.0, 365 * 86400.0])
def test_one_reading_stamped_ahead_costs_itself_only(arrivals, ahead):
    t = T.copy()
    t[200] += ahead
    made = Outcome(events(t, T + DELAY if arrivals else None))
    assert made.numbers.tolist() == [*range(200), *range(201, 2000)]
    assert made.stale == 0 and not made.moved
    (refused,) = made.refused
    assert refused.t == round(t[200] * SECOND) and refused.expected == 199 * SECOND


@pytest.mark.parametrize("ahead", [HOUR, -HOUR, 30.0, -30.0])
def test_a_clock_that_was_set_is_named_and_goes_on(ahead):
    """With arrivals the step is known to the delay, which here is the same for all: no time is off at all."""
    t = T + np.where(T >= 200, ahead, 0.0)
    made = Outcome(events(t, T + DELAY))
    np.testing.assert_array_equal(made.seconds, T)
    assert made.numbers.tolist() == list(range(2000)) and not made.refused and not made.stale
    (moved,) = made.moved
    assert moved.by == round(ahead * SECOND) and moved.t == round(t[200] * SECOND)


def test_a_step_is_known_within_the_jitter_of_the_delay():
    """The least delay of those that settled it, against the least of the ones before: off by the jitter at most."""
    jitter = np.random.default_rng(4).uniform(0.0, 0.3, T.size)
    made = Outcome(events(T + np.where(T >= 200, HOUR, 0.0), T + jitter))
    assert not made.refused and not made.stale and len(made.moved) == 1
    assert np.abs(made.seconds - T).max() <= 0.3


def test_a_table_whose_clock_is_set_back_goes_on_at_its_own_pace():
    made = Outcome(events(T - np.where(T >= 1000, 300.0, 0.0)))
    np.testing.assert_array_equal(made.seconds, T)
    assert [move.by for move in made.moved] == [-300 * SECOND]


@pytest.mark.parametrize("back", [299.0, 400.0, 1e6])
def test_a_table_whose_clock_is_set_back_before_its_first_time_goes_on_once_it_overlaps(back):
    """As far back as it likes; a block that never comes to what was measured may be of files in a wrong order."""
    made = Outcome(events(T - np.where(T >= 300, back, 0.0)))
    if back > 2000 - 300:
        assert made.stale == 1700 and not made.moved
        return
    np.testing.assert_array_equal(made.seconds, T)
    assert [move.by for move in made.moved] == [-round(back * SECOND)] and made.stale == 0


@pytest.mark.parametrize("after", [300, 1000])
@pytest.mark.parametrize("back", [900.0, HOUR, 5.5 * HOUR, 24 * HOUR])
def test_a_table_that_changes_its_time_zone_before_it_overlaps_goes_on(after, back):
    """The step is exact, though the samples are irregular; a slow channel follows the others."""
    t = T + np.random.default_rng(6).uniform(0.0, 0.6, T.size)
    slow = np.r_[np.arange(0.0, 2000.0, 60.0) + 0.5]
    t, channel = np.r_[t, slow], np.r_[np.zeros(t.size), np.ones(slow.size)].astype(np.int32)
    order = np.argsort(t)
    t, channel = t[order], channel[order]
    made = Outcome(events(t - np.where(t >= after, back, 0.0), channel=channel))
    np.testing.assert_allclose(made.seconds, t, atol=1e-6)
    assert {move.by for move in made.moved} == {-round(back * SECOND)} and made.stale == 0


@pytest.mark.parametrize("hours", [1, 3])
def test_files_of_whole_hours_in_the_wrong_order_are_no_change_of_time_zone(hours):
    t = np.arange(0.0, 2 * hours * HOUR, 10.0)
    half = t.size // 2
    made = Outcome(events(np.concatenate((t[half:], t[:half]))))
    assert made.stale == half and not made.moved


def test_sensors_of_one_clock_keep_their_times_to_each_other():
    """Two sensors at 1 and 4 Hz: alone each would go on at its own pace, apart by up to a period of the slower."""
    t = np.concatenate((T, np.sort(np.random.default_rng(9).uniform(0.0, 500.0, T.size))))
    sensor = np.repeat([0, 1], T.size)
    order = np.argsort(t, kind="stable")
    order = order[t[order] < 490.0]
    t, sensor = t[order], sensor[order]
    made = Outcome(events(t - np.where(t >= 400.0, 300.0, 0.0), channel=sensor))
    assert not made.refused and not made.stale and len(made.moved) == 2
    true = np.round(t * SECOND).astype(np.int64)[made.numbers.astype(int)]
    late = made.log.events.t - true
    assert np.all(late[:100] == 0) and np.ptp(late[true > 400 * SECOND]) == 0


class Two:
    """Two sensors at 100 Hz for 80 s, what is ahead of the clock of the first, and their delays; as they arrive."""

    def __init__(self, ahead, delay):
        self.true = np.repeat(np.arange(0.0, 80.0, 0.01), 2)
        sensor = np.tile([0, 1], self.true.size // 2)
        late = DELAY + np.where(sensor == 0, delay(self.true), 0.0)
        stamp = self.true + np.where(sensor == 0, ahead(self.true), 0.0)
        order = np.argsort(self.true + late, kind="stable")
        self.late = late > HORIZON / SECOND
        stream = events(stamp[order], (self.true + late)[order], channel=sensor[order])
        self.made = Outcome(stream._replace(value=order[:, None].astype(float)))
        self.kept = self.made.numbers.astype(int)
        self.lost = np.setdiff1d(np.arange(self.true.size), self.kept)
        self.off = np.abs(self.made.seconds - self.true[self.kept])


@pytest.mark.parametrize("ahead", [1.5, 2.1, 2.97, 3.9])
def test_a_clock_a_little_ahead_does_not_make_what_others_say_stale(ahead):
    """When time has come to where it is, it is as much ahead as before."""
    two = Two(lambda t: np.where(t >= 20, ahead, 0.0), lambda t: 0.0 * t)
    assert two.lost.size == 0 and [move.by for move in two.made.moved] == [round(ahead * SECOND)]
    assert two.off.max() < 1e-9


@pytest.mark.parametrize("delay", [0.4, 3.0])
def test_what_is_held_up_while_its_clock_comes_back_leaves_nothing_behind(delay):
    """The step back is measured off by the delay. Only what was too long on its way is late; then all is as it was.

    Where the delay is over, what was said in the seconds of it and what is said now come in turns, of two clocks to
    all appearance: the one ahead is refused until the other has ended.
    """
    two = Two(lambda t: np.where((t >= 20) & (t < 40), HOUR, 0.0), lambda t: np.where((t >= 38) & (t < 55), delay, 0.0))
    refused = len(two.made.refused)
    assert 0 < refused <= 300 if delay == 3.0 else not refused
    assert two.lost.size == two.made.stale + refused and np.all(two.late[two.lost] | (two.true[two.lost] >= 55))
    assert not np.any(two.lost % 2) and two.off[two.true[two.kept] > 59].max() < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_a_clock_is_set_back_under_any_delays_and_only_what_was_late_is_stale(seed):
    rng = np.random.default_rng(seed)
    two = Two(lambda t: np.where((t >= 20) & (t < 50), -30.0, 0.0), lambda t: rng.exponential(0.8, t.size))
    assert two.late.sum() > 500 and np.all(two.late[two.lost])
    # The least of 200 delays is below 0.8 s / 200 times 7, but for one in a thousand.
    assert len(two.made.moved) == 2 and two.off.max() <= 0.03


@pytest.mark.parametrize("arrivals", [False, True])
def test_a_night_without_data_is_as_it_was(arrivals):
    t = T + np.where(T >= 700, 36000.0, 0.0) + np.where(T >= 1500, 90.0, 0.0)
    made = Outcome(events(t, t + DELAY if arrivals else None))
    np.testing.assert_array_equal(made.seconds, t)
    assert not made.refused and not made.moved and not made.stale


def test_inputs_that_change_seldom_are_no_jumps():
    """They come at once, as the readings do: their own pace says nothing."""
    at = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 500.0, 1500.0])
    readings, inputs = events(T), events(at, kind=INPUT)
    stream = Events.concat([readings, inputs], 1)
    stream = stream.select(np.argsort(stream.t, kind="stable"))
    made = Outcome(stream)
    np.testing.assert_array_equal(made.log.events.t, stream.t)


def test_a_wrong_row_of_a_table_is_refused_whole():
    t = np.repeat(T, 3)
    t[300:303] += HOUR
    stream = events(t)._replace(kind=np.tile(np.array([INPUT, READING, TRUTH], np.int8), T.size))
    made = Outcome(stream)
    assert len(made.refused) == 3 and made.stale == 0 and made.log.n == 5997


def without_guard(stream):
    """How many the log has and has dropped as stale, event by event."""
    log = Log(1)
    stale = sum(log.extend(stream.select(slice(k, k + 1)), HORIZON)[1] for k in range(len(stream)))
    return log.n, stale


def test_late_readings_are_as_before():
    """A block that fills a gap, without arrivals: stale beyond the horizon, and no clock that went back."""
    stream = events(np.concatenate((T[:100], T[160:220], T[100:160], T[220:])))
    made = Outcome(stream)
    assert (made.log.n, made.stale) == without_guard(stream) and made.stale == 60
    assert not made.refused and not made.moved


@pytest.mark.parametrize("until", [359.5, 360.0, 363.5])
def test_a_block_that_was_held_up_on_its_way_is_late_not_another_clock(until):
    """It arrives in one go, so t - arrival is another for each reading; those after newer ones are stale."""
    arrival = np.where((T >= 300) & (T < 360), until + (T - 300) * 1e-3, T) + DELAY
    order = np.argsort(arrival, kind="stable")
    stream = events(T[order], arrival[order])
    made = Outcome(stream)
    assert (made.log.n, made.stale) == without_guard(stream)
    assert not made.moved and not made.refused


def test_the_host_clock_that_is_set_is_no_matter():
    """Its times go on evenly, whatever arrival says."""
    for step in (HOUR, -HOUR):
        made = Outcome(events(T, T + np.where(T >= 300, step, 0.0) + DELAY))
        np.testing.assert_array_equal(made.seconds, T)
        assert not made.moved and not made.refused


def test_a_lone_last_reading_is_refused_only_where_no_gap_is_so_long():
    assert len(Outcome(events([*T, 1e6])).refused) == 1
    assert Outcome(events([*T, 1e6, 1e6 + 1])).log.n == 2002
    assert Outcome(events([*T, 3500.0])).log.n == 2001


def test_queries_and_resets_pass_whatever_their_time():
    stream = Events.concat([events(T), events([1e7], kind=TICK), events(T[-1] + 1 + T)], 1)
    made = Outcome(stream)
    assert made.log.n == 4001


def spoiled(seed):
    """Two sensors, inputs and truth with lone jumps, steps there and back, gaps and late ones, with arrivals or not."""
    rng = np.random.default_rng(seed)
    n = 400
    t = np.cumsum(rng.exponential(0.2, n)) + np.where(np.arange(n) > rng.integers(n), rng.choice([0.0, 500.0]), 0.0)
    arrival = t + rng.exponential(0.05, n)
    stamped = t.copy()
    for _ in range(rng.integers(4)):
        begin, length = rng.integers(n), rng.integers(1, 150)
        stamped[begin : begin + length] += rng.choice([-1, 1]) * rng.choice([5.0, 60.0, 3600.0])
    late = rng.random(n) < 0.05
    stamped[late] -= rng.uniform(0.0, 6.0, late.sum())
    stream = events(stamped, arrival if rng.random() < 0.6 else None)
    kind = rng.choice(np.array([READING, READING, INPUT, TRUTH, TICK], np.int8), n)
    channel = np.where(kind == READING, rng.integers(0, 2, n), 0).astype(np.int32)
    return stream._replace(kind=kind, channel=channel)


SEEDS = st.integers(0, 2**32 - 1)


STEPS = [sign * step for step in (60.0, HOUR, 24 * HOUR, 87_660 * HOUR) for sign in (1, -1)]
SENT = np.arange(0.0, 60.0, 0.1)


@pytest.mark.parametrize(("step", "horizon"), [*((step, 2) for step in (1.2, 2.5, *STEPS)), (50.0, 60), (250.0, 600)])
@pytest.mark.parametrize("spans", [[(10, 15)], [(10, 15), (30, 45)], [(0, 5)], [(40, 60)]])
def test_senders_of_utc_that_are_wrong_for_a_while_lose_nothing(step, horizon, spans):
    """Also where they are wrong from the start, as after a restart of the twin, or ahead by less than the horizon."""
    wrong = np.any([(first <= SENT) & (last > SENT) for first, last in spans], axis=0)
    stream = events(SENT + step * wrong, SENT + DELAY)
    found = Outcome(stream, cuts=range(0, 600, 7), horizon=horizon * SECOND, utc=True)
    assert (found.stale, found.refused) == (0, [])
    # History may begin at any time: what is back from the start stays where it is, and what follows goes on from there.
    late = step if spans[0][0] == 0 and step < 0 else 0.0
    true = SENT[found.numbers.astype(int)]
    np.testing.assert_allclose(found.seconds, true + late * (true < 5.0), atol=0.2)


def test_what_is_late_by_less_than_the_horizon_is_used_though_its_clock_is_wrong():
    arrival = SENT + np.where(np.arange(600) % 37 == 0, 1.5, DELAY)
    order = np.argsort(arrival)
    found = Outcome(events((SENT + HOUR)[order], arrival[order]), utc=True)
    assert (found.stale, found.refused) == (0, [])


def test_a_clock_that_drifts_makes_no_other_sender_late():
    """By 200 ppm it is 4 s ahead in the end: it is set back each time that it is a second ahead."""
    t = np.arange(0.0, 20_000.0, 2.0)
    stamp = np.stack((t, (t + 1.0) * 1.0002), axis=1).ravel()
    true = np.stack((t, t + 1.0), axis=1).ravel()
    found = Outcome(events(stamp, true + DELAY, channel=np.tile([0, 1], t.size)), utc=True)
    off = found.seconds - true[found.numbers.astype(int)]
    assert (found.stale, found.refused, len(found.moved)) == (0, [], 3)
    assert np.all(off[found.log.events.channel == 0] == 0) and -0.01 < off.min() and off.max() < 1.011


@pytest.mark.parametrize("alone", [0.0, 10.0])
@pytest.mark.parametrize("step", STEPS)
def test_of_two_senders_of_utc_the_one_that_is_right_is_used(step, alone):
    """Whichever came first: while the wrong one is `alone`, its clock is corrected."""
    wrong = ((np.arange(600) % 2 == 1) & (SENT < 55.0)) | (SENT < alone)
    found = Outcome(events(SENT + step * wrong, SENT + DELAY), utc=True)
    numbers = found.numbers.astype(int)
    assert set(np.flatnonzero(~wrong)) <= set(numbers)
    np.testing.assert_allclose(found.seconds[~wrong[numbers]], SENT[numbers[~wrong[numbers]]], atol=1e-9)
    if alone == 0.0:
        assert found.stale + len(found.refused) == wrong.sum() and not found.moved


@pytest.mark.parametrize("order", [1, -1])
def test_a_backlog_is_no_step_of_a_clock(order):
    """An hour that was buffered comes within a second, in either order; then what is measured now."""
    buffered, live = np.arange(0.0, HOUR, 1.0)[::order], HOUR + np.arange(1.0, 60.0)
    arrival = np.concatenate((HOUR + np.linspace(0.0, 0.9, buffered.size), live + DELAY))
    found = Outcome(events(np.concatenate((buffered, live)), arrival), utc=True)
    assert not found.refused and not found.moved
    assert set(range(3600, 3659)) <= set(found.numbers) and (order < 0 or found.stale == 0)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(SEEDS, st.sets(st.integers(0, 400), max_size=40) | st.just(range(1, 400)))
def test_cuts_change_nothing_and_everything_is_counted(seed, cuts):
    """However the stream is cut into batches, down to single events."""
    stream = spoiled(seed)
    assert Outcome(stream, cuts).told() == Outcome(stream).told()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(SEEDS)
def test_what_is_in_time_passes_untouched(seed):
    """Readings late by less than the horizon, in the order of arrival: all of them, and at once."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.exponential(0.1, 500))
    arrival = t + rng.uniform(0.0, rng.uniform(0.0, 1.5), 500)
    order = np.argsort(arrival, kind="stable")
    stream = events(t[order], arrival[order], channel=rng.integers(0, 2, 500))
    passed = ClockGuard(2, HORIZON).take(stream)
    assert passed.events is stream and not passed.settled.any()
