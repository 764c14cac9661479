"""Episodes do not depend on how the rows of a fold are divided into chunks, nor on rows that are replaced."""

from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from estimators.diagnostics.detectors import memory_flag
from estimators.diagnostics.effects import EVIDENCE, KINDS, gains
from estimators.diagnostics.episodes import EpisodeTracker, judged_rows
from estimators.log import READING
from tests.estimators.diagnostics.episodes.test_find import SENSORS, folded

FAULTS = {
    **SENSORS,
    "silent": {"skip": (0,)},
    "outside": {"feed": 3.0},
    "gap": {},
    "corrected": {},
}
GAP_S = 20.0


@cache
def rows_with(fault):
    judged = judged_rows(folded(**FAULTS[fault]))
    if fault == "corrected":
        rows = np.flatnonzero(judged.events.kind == READING)
        judged.track.flags[rows[(rows > 1000) & (np.arange(rows.size) % 140 < 50)]] |= memory_flag(0)
    if fault != "gap":
        return judged
    late = np.arange(len(judged.track)) >= len(judged.track) // 2
    t = judged.events.t + np.where(late, round(GAP_S * 1e9), 0)
    return judged._replace(events=judged.events._replace(t=t), stale_after=15.0)


def tracked(judged, max_rows, sizes, rewind=0):
    """Episodes of a tracker that is fed chunks of these sizes, over and over; each replaces the last `rewind` rows."""
    tracker = EpisodeTracker(
        judged.model, judged.tuning, judged.marginal, max_rows=max_rows, stale_after=judged.stale_after
    )
    done, k = 0, 0
    while done < len(judged.track):
        begin = max(tracker.first, done - rewind) if sizes[k % len(sizes)] > rewind else done
        end = begin + sizes[k % len(sizes)]
        tracker.feed(judged.events.select(slice(begin, end)), judged.track.select(slice(begin, end)), begin)
        done, k = min(end, len(judged.track)), k + 1
        if k % 7 == 0:
            assert tracker.entries is tracker.entries
        assert tracker.n < max_rows
    return tracker.episodes


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    fault=st.sampled_from(sorted(FAULTS)),
    max_rows=st.sampled_from([600, 1501, 65_536]),
    sizes=st.lists(st.integers(1, 900), min_size=1, max_size=6),
    rewind=st.integers(0, 40),
)
def test_chunks_and_replaced_rows_give_the_same_episodes(fault, max_rows, sizes, rewind):
    judged = rows_with(fault)
    sizes = [max(size, rewind + 1, 97) for size in sizes]
    once = tracked(judged, max_rows, [len(judged.track)])
    many = tracked(judged, max_rows, sizes, rewind)
    assert [repr(item) for item in many] == [repr(item) for item in once]


def test_a_gap_of_a_recording_without_any_event_is_an_episode():
    judged = rows_with("gap")
    t, k = judged.events.t * 1e-9, len(judged.track) // 2
    (found,) = (item for item in tracked(judged, 65_536, [1000]) if item.cause == "stale")
    start = t[k - 1] - judged.track.age[k - 1]
    assert (found.subject, found.start, found.end) == ("twin", pytest.approx(start), pytest.approx(t[k]))
    assert found.size == pytest.approx(t[k] - start) and found.size > GAP_S
    assert not [item for item in tracked(judged._replace(stale_after=30.0), 65_536, [1000]) if item.cause == "stale"]


@pytest.mark.parametrize("cause", [*SENSORS, "corrected"])
def test_rows_that_are_dropped_do_not_move_the_ends(cause):
    judged, subject = rows_with(cause), next(iter(SENSORS[cause])) if cause in SENSORS else "level"
    (expected,) = (item for item in tracked(judged, 65_536, [1000]) if item.subject.startswith(subject))
    (found,) = (item for item in tracked(judged, 1501, [1000]) if item.subject.startswith(subject))
    assert (found.cause, found.start) == (expected.cause, expected.start)
    assert found.end == pytest.approx(expected.end, abs=1e-6)


def test_rows_before_those_that_are_kept_are_rejected():
    judged = rows_with("narrow")
    tracker = EpisodeTracker(judged.model, judged.tuning, judged.marginal, max_rows=600)
    tracker.feed(judged.events, judged.track)
    with pytest.raises(IndexError, match="row 0 is not among rows"):
        tracker.feed(judged.events, judged.track, 0)


@pytest.mark.parametrize("kind", [*KINDS, EVIDENCE])
def test_gains_continue_from_sums(kind):
    e = np.random.default_rng(3).standard_normal(300) * np.where(np.arange(300) % 40, 1.3, 5.0)
    whole, sums = gains(e, kind)
    parts, run = [], gains(e[:0], kind)[1]
    for piece in np.split(e, [1, 2, 90, 90, 203]):
        gain, run = gains(piece, kind, run)
        parts.append(gain)
    # Sums of 300 numbers in another order.
    np.testing.assert_allclose(np.concatenate(parts), whole, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(run, sums, rtol=1e-12)
