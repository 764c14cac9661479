"""Offset and drift of a clock from arrivals: simulated clocks whose offset and drift are known."""

import numpy as np
import pytest

from estimators.diagnostics.clock_fit import MAX_SEGMENTS, LeastDelays
from tests.support import SECOND


def stamped(seed, *, offset=0.0, ppm=0.0, seconds=600, rate=20, least=0.0, mean=0.02, begin=1_700_000_000):
    """Readings of a clock that runs `ppm` fast, `offset` ahead at the end: t and arrival, ns."""
    rng = np.random.default_rng(seed)
    sent = np.sort(rng.uniform(0, seconds, seconds * rate))
    arrival = sent + least + rng.exponential(mean, sent.size)
    order = np.argsort(arrival)
    sent, arrival = sent[order], arrival[order]
    t = sent + offset + ppm * 1e-6 * (sent - seconds)
    return np.round((t + begin) * 1e9).astype(np.int64), np.round((arrival + begin) * 1e9).astype(np.int64)


def fitted(t, arrival, pieces=1):
    delays = LeastDelays()
    for part in np.array_split(np.arange(t.size), pieces):
        delays.note(t[part], arrival[part])
    return delays.fit()


@pytest.mark.parametrize("ppm", [-150.0, 0.0, 40.0, 1000.0])
def test_the_interval_of_the_drift_holds_the_truth_as_often_as_it_says(ppm):
    """95 % of 200 trials, within three deviations of that share (0.046)."""
    inside = 0
    for seed in range(200):
        fit = fitted(*stamped(seed, ppm=ppm))
        inside += abs(fit.drift_ppm - ppm) <= fit.drift_error_ppm
        # Stretches are of 2 s by then. The least of some 40 delays of 20 ms in the mean scatters by 0.5 ms; a line
        # through 300 of them knows its slope to 1.96 sqrt(12/300) 0.5 ms/600 s = 0.33 ppm, at 1000 ppm a little
        # more, as 2 ms pass in each.
        assert 0.33 / 1.7 < fit.drift_error_ppm < 0.33 * 1.7
    assert abs(inside / 200 - 0.95) <= 3 * np.sqrt(0.95 * 0.05 / 200)


@pytest.mark.parametrize("offset", [-3600.0, -0.2, 0.0, 5.0])
def test_the_offset_is_known_to_the_least_delay(offset):
    fit = fitted(*stamped(1, offset=offset, ppm=20.0, least=0.005))
    # Of 12,000 delays the least is a few microseconds above `least`; the line is that close to the edge all along.
    assert fit.offset == pytest.approx(offset - 0.005, abs=0.0015)


def test_time_in_which_all_was_held_up_does_not_bend_the_line():
    """A fifth of the time with half a second more: a line through the means would drift by hundreds of ppm."""
    t, arrival = stamped(2, ppm=30.0)
    held = (arrival - arrival[0]) > 480 * SECOND
    fit = fitted(t, arrival + np.where(held, SECOND // 2, 0))
    assert abs(fit.drift_ppm - 30.0) < 1.5


def test_pieces_change_nothing():
    t, arrival = stamped(3, ppm=-70.0, seconds=2000, rate=5)
    whole = fitted(t, arrival)
    assert all(fitted(t, arrival, pieces) == whole for pieces in (7, 500, t.size))


def test_memory_is_bounded_and_a_day_is_a_line_too():
    t, arrival = stamped(4, ppm=12.5, seconds=86400, rate=1)
    delays = LeastDelays()
    delays.note(t, arrival)
    assert len(delays._at) <= MAX_SEGMENTS
    assert abs(delays.fit().drift_ppm - 12.5) < 0.05


def test_little_is_said_of_little():
    assert LeastDelays().fit() is None
    fit = fitted(*stamped(5, seconds=4, rate=3, offset=1.0, mean=0.001))
    assert fit.offset == pytest.approx(1.0, abs=0.01) and np.isnan(fit.drift_ppm)
