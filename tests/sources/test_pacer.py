"""Playback against a clock that the test moves: what is due comes, in order, once."""

import threading

import numpy as np
import pytest

from estimators.log import READING, Events
from sources.merged import MemorySource
from sources.pacer import MAX_BATCH_EVENTS, Pacer
from tests.support import SECOND, Clock, read_all
from tests.waiting import LIMIT_S


def events(times):
    t = np.array([round(100 * SECOND + x * SECOND) for x in times], np.int64)
    return Events.alike(READING, t, np.arange(t.size, dtype=float))


def player(times=(0, 1, 2, 3, 4, 5), *, batch=2, **more):
    clock = Clock(7 * SECOND)
    return Pacer(lambda: MemorySource(events(times), batch=batch), clock=clock, **more), clock


def due(pacer):
    """Numbers of all events that are due now."""
    got = []
    while True:
        batch = pacer.read(0.0)
        if batch is None or not len(batch):
            return got
        got += batch.value[:, 0].astype(int).tolist()


def test_events_come_when_playback_reaches_them():
    pacer, clock = player()
    assert due(pacer) == [0]
    clock.wait(0.999)
    assert due(pacer) == []
    clock.wait(0.001)
    assert due(pacer) == [1] and pacer.now() == 101 * SECOND
    clock.wait(2.5)
    assert due(pacer) == [2, 3]
    clock.wait(10)
    assert due(pacer) == [4, 5] and pacer.read(0.0) is None


@pytest.mark.parametrize(("speed", "seconds"), [(2.0, 1.0), (0.1, 20.0), (10.0, 0.2)])
def test_speed(speed, seconds):
    pacer, clock = player(speed=speed)
    due(pacer)
    clock.wait(seconds)
    assert due(pacer) == [1, 2] and pacer.now() == 102 * SECOND


def test_a_change_of_speed_holds_from_then_on():
    pacer, clock = player()
    due(pacer)
    clock.wait(1.5)
    assert due(pacer) == [1]
    pacer.set_speed(3.0)
    assert pacer.now() == round(101.5 * SECOND)
    clock.wait(0.5)
    assert due(pacer) == [2, 3] and pacer.now() == 103 * SECOND


def test_the_present_does_not_run_ahead_of_what_was_read():
    """A night at a thousand million times: a tick years ahead would make all that follows stale."""
    pacer, clock = player(speed=1e9)
    due(pacer)
    clock.wait(0.5)
    assert pacer.now() == 101 * SECOND
    assert pacer.read(0.0).value[:, 0].tolist() == [1]
    clock.wait(0.5)
    # The next batch is not read yet, so nothing is known after the last.
    assert pacer.now() == 101 * SECOND


def test_as_fast_as_possible_is_everything_in_breaths():
    pacer, _ = player(times=np.arange(10_000) * 0.5, batch=10_000, speed=float("inf"))
    sizes = []
    while (batch := pacer.read(0.0)) is not None:
        sizes.append(len(batch))
    assert max(sizes) <= MAX_BATCH_EVENTS and sum(sizes) == 10_000


@pytest.mark.parametrize(("speed", "seconds"), [(1e300, 1e-6), (1e300, 1e9), (1e9, 1e6)])
def test_a_playhead_beyond_all_times_releases_everything(speed, seconds):
    pacer, clock = player(speed=speed)
    pacer.read(0.0)
    clock.wait(seconds)
    assert due(pacer) == [1, 2, 3, 4, 5]
    pacer.pause()
    pacer.seek(100 * SECOND)
    assert due(pacer) == [0]


def test_pause_and_resume():
    pacer, clock = player()
    due(pacer)
    clock.wait(0.5)
    pacer.pause()
    clock.wait(100)
    assert pacer.paused and due(pacer) == [] and pacer.now() == round(100.5 * SECOND)
    pacer.resume()
    assert due(pacer) == []
    clock.wait(0.5)
    assert due(pacer) == [1]


def test_a_step_releases_the_next_timestamp_whole():
    pacer, clock = player(times=(0, 1, 1, 1, 1, 2, 3), batch=2)
    due(pacer)
    pacer.pause()
    pacer.step()
    assert due(pacer) == [1, 2, 3, 4], "also where a timestamp spreads over the source's batches"
    assert due(pacer) == [] and pacer.now() == 101 * SECOND
    pacer.step()
    assert due(pacer) == [5] and pacer.now() == 102 * SECOND
    pacer.resume()
    clock.wait(1.0)
    assert due(pacer) == [6]


@pytest.mark.parametrize("paused", [False, True])
def test_a_seek_ahead_releases_what_lies_between_at_once(paused):
    pacer, clock = player()
    due(pacer)
    if paused:
        pacer.pause()
    pacer.seek(103 * SECOND)
    assert due(pacer) == [1, 2, 3] and pacer.now() == 103 * SECOND and pacer.restarts == 0
    clock.wait(1.0)
    assert due(pacer) == ([] if paused else [4])


@pytest.mark.parametrize("ended", [False, True])
def test_a_seek_back_begins_again(ended):
    pacer, clock = player()
    due(pacer)
    clock.wait(50 if ended else 4)
    assert due(pacer) == ([1, 2, 3, 4, 5] if ended else [1, 2, 3, 4])
    pacer.seek(102 * SECOND)
    assert due(pacer) == [0, 1, 2] and pacer.restarts == 1 and pacer.now() == 102 * SECOND
    clock.wait(1.0)
    assert due(pacer) == [3]


def test_a_late_reading_comes_with_the_one_before_it():
    pacer, clock = player(times=(0, 3, 1, 4), batch=4)
    due(pacer)
    clock.wait(2.0)
    assert due(pacer) == []
    clock.wait(1.0)
    assert due(pacer) == [1, 2]
    clock.wait(1.0)
    assert due(pacer) == [3]


@pytest.mark.parametrize("seed", range(10))
def test_whatever_is_pressed_each_event_comes_once_and_in_order(seed):
    rng = np.random.default_rng(seed)
    times = np.sort(rng.integers(0, 40, 60)) * 0.25
    pacer, clock = player(times=times, batch=int(rng.integers(1, 7)))
    got, restarts = [], 0
    for _ in range(300):
        press = rng.integers(8)
        if press == 0:
            pacer.pause()
        elif press == 1:
            pacer.resume()
        elif press == 2:
            pacer.step()
        elif press == 3:
            pacer.set_speed(float(rng.choice([0.1, 1.0, 20.0, np.inf])))
        elif press == 4:
            pacer.seek(100 * SECOND + round(rng.uniform(0, 10) * SECOND))
        else:
            clock.wait(rng.uniform(0, 0.5))
        batch = pacer.read(0.0)
        if pacer.restarts != restarts:
            got, restarts = [], pacer.restarts
        if batch is not None:
            got += batch.value[:, 0].astype(int).tolist()
        assert got == list(range(len(got)))
    assert restarts > 0


def test_a_reader_that_waits_is_woken_by_a_seek():
    """The reader waits for an event an hour away; if it is not woken, the join below runs into its limit."""
    pacer, _ = player(times=(0, 3600))
    due(pacer)
    got = []
    thread = threading.Thread(target=lambda: got.append(pacer.read(10.0 * LIMIT_S)))
    thread.start()
    pacer.seek(3700 * SECOND)
    thread.join(LIMIT_S)
    assert not thread.is_alive()
    numbers = [int(v) for batch in got for v in batch.value[:, 0]] + due(pacer)
    assert numbers == [1]


def test_everything_that_the_source_said_comes_unchanged():
    pacer, _ = player(speed=float("inf"))
    got, expected = read_all(pacer), read_all(MemorySource(events(range(6))))
    assert np.array_equal(got.t, expected.t) and np.array_equal(got.value, expected.value)
    assert np.array_equal(got.kind, expected.kind) and np.array_equal(got.channel, expected.channel)
