"""Whatever arrives, in whatever order: nothing is lost uncounted, and the fold is that of the log in order.

Events go through intake, log and fold as the engine and `nisus fold` hand them on.
"""

from collections import Counter
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.twin.ingest import CLOCK_MOVED, Ingest
from estimators.diagnostics.health import HealthPolicy
from estimators.fold import Fold
from estimators.log import MAINTENANCE, MARK, READING, RESET, TICK, TRUTH, Events, Log, sorted_order
from estimators.model.parts import Limits, Stuck
from estimators.tuning import Tuning
from sources.source import WRONG_TIME
from tests.estimators.test_plausibility import model
from tests.support import SECOND, as_log, assert_same

BEAT = SECOND // 4
HORIZON = 8
"""Beats."""

MODEL = model(
    a=Limits(range=((-50.0, 50.0),), rate=(100.0,), stuck=Stuck(readings=3)),
    b=Limits(duplicates=0.5, saturation=((-55.0, 55.0),)),
)

FILTERS = {
    "kf": {},
    "ekf": {},
    "ukf": {},
    "sr-ukf": {},
    "pf": {"particles": 48},
    "enkf": {"members": 16},
    "filterpy-kf": {},
}
GATES = {"off": (None, "hard"), "hard": (0.99, "hard"), "soft": (0.99, "soft")}


class Told(NamedTuple):
    """One event: beats since the one before, beats until it arrives, copies, by how many beats its stamp is wrong."""

    gap: int
    kind: int
    channel: int
    value: tuple[float, float]
    delay: int
    copies: int
    wrong: int


VALUES = st.one_of(
    st.integers(-20, 20).map(float), st.sampled_from([np.nan, 1e6, -1e6, 3.0, 3.0]), st.floats(-60, 60, width=32)
)
GAPS = st.one_of(st.integers(0, 4), st.integers(0, 4), st.sampled_from([0, 1, 1, 40, 4000, 4 * 86400]))
KINDS = st.sampled_from([READING] * 12 + [TRUTH, TICK, RESET, MAINTENANCE, MARK])


def told(delays, wrong, least=1):
    """Streams of events."""
    one = st.builds(Told, GAPS, KINDS, st.integers(0, 1), st.tuples(VALUES, VALUES), delays, st.integers(0, 2), wrong)
    return st.lists(one, min_size=least, max_size=60)


def stream(items):
    """The events in the order of arrival; a clock that is wrong by w beats stays so until another w is told."""
    rows, now = [], 40
    for item in items:
        now += item.gap
        t, arrival = (now + item.wrong) * BEAT, (now + item.delay) * BEAT
        if item.kind == READING:
            value = item.value[: item.channel + 1]
        else:
            value = item.value if item.kind == TRUTH else (1.0,) if item.kind == MARK else ()
        channel = item.channel if item.kind in (READING, MAINTENANCE) else 0
        rows += [Events.one(t, arrival, item.kind, channel, value, MODEL.width)] * (1 + item.copies)
    events = Events.concat(rows, MODEL.width)
    return events.select(np.argsort(events.arrival, kind="stable"))


class Twin:
    """Ingest, log and fold, as the engine has them."""

    def __init__(self, estimator="kf", gate="hard"):
        self.counts: Counter[str] = Counter()
        self.stale = 0
        self.log = Log.of(MODEL, capacity=8)
        self.intake = Ingest(MODEL, HORIZON * BEAT, lambda key, text: self.counts.update([key]))
        self.fold = folded(estimator, gate, self.log)

    def take(self, events, cuts):
        """Events in batches that end at these places, and the source's end; the moments are looked at after each."""
        bounds = [0, *sorted(min(cut, len(events)) for cut in cuts), len(events)]
        for a, b in zip(bounds, bounds[1:], strict=False):
            self._put(self.intake.take(events.select(slice(a, b))))
            is_covariance(self.fold)
        self._put(self.intake.finish())
        is_covariance(self.fold)

    def _put(self, passed):
        first, stale = self.log.extend(passed.events, HORIZON * BEAT, passed.settled)
        self.stale += stale
        self.fold.rewind(first)
        self.fold.advance()


def folded(estimator, gate, log):
    """A fold of what the log holds; a refused sensor is judged, and believed after 5 s."""
    share, kind = GATES[gate]
    tuning = Tuning.of(MODEL).set("gate", share).set("gate.kind", kind).set("gate.reopen", 5.0)
    fold = Fold(estimator, MODEL, tuning.with_options(FILTERS[estimator]), log, policy=HealthPolicy())
    fold.advance()
    return fold


def is_covariance(fold):
    """Finite, symmetric, and no eigenvalue below zero but for what rounding leaves.

    The eigenvalues are exact to some ulp of the largest, and an update rounds by no more than that: with two states and
    condition numbers of some hundreds 1e-12 of the trace is a thousand times as much.
    """
    mean, P = fold.moments()
    assert np.all(np.isfinite(mean)) and np.all(np.isfinite(P))
    np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-12 * np.trace(P))
    assert np.linalg.eigvalsh(P).min() >= -1e-12 * np.trace(P)


def in_order(events):
    """A log to which these events came in the order of measured time."""
    return as_log(events.select(sorted_order(events)))


CUTS = st.lists(st.integers(0, 180), max_size=12)
ONCE = settings(deadline=None, max_examples=25, suppress_health_check=list(HealthCheck))


@pytest.mark.parametrize("estimator", FILTERS)
@ONCE
@given(told(st.integers(1, HORIZON), st.just(0)), CUTS, st.sampled_from(sorted(GATES)))
def test_what_comes_within_the_horizon_is_folded_as_if_it_had_come_in_order(estimator, items, cuts, gate):
    events = stream(items)
    twin = Twin(estimator, gate)
    twin.take(events, cuts)
    assert twin.stale == 0 and not twin.counts and twin.intake.held == 0
    expected = folded(estimator, gate, in_order(events))
    assert_same(twin.log.events, expected.log.events)
    assert_same(twin.fold.track, expected.track)
    assert_same_numbers(twin.fold, expected)


def assert_same_numbers(a, b):
    """The same state of filter and bank, bit for bit."""
    for left, right in zip((*a.moments(), a.evidence), (*b.moments(), b.evidence), strict=True):
        np.testing.assert_array_equal(left, right)


WRONG = st.sampled_from([0] * 12 + [14400, -14400, 240, -240, 20, -20])


@pytest.mark.parametrize("estimator", FILTERS)
@ONCE
@given(told(st.integers(0, 2) | st.integers(0, 4 * HORIZON), WRONG, 20), CUTS, CUTS, st.sampled_from(sorted(GATES)))
def test_whatever_clocks_say_nothing_is_lost_uncounted(estimator, items, cuts, others, gate):
    """Each event is in the log, or was too late, or was refused for its time; with any cuts the same ones."""
    events = stream(items)
    twin, cut_otherwise = Twin(estimator, gate), Twin(estimator, gate)
    twin.take(events, cuts)
    assert twin.log.n + twin.stale + twin.counts[WRONG_TIME] == len(events) and twin.intake.held == 0
    assert not said_of(twin.log.events) - said_of(events)
    assert_same(twin.fold.track, folded(estimator, gate, in_order(twin.log.events)).track)
    cut_otherwise.take(events, others)
    assert_same(twin.log.events, cut_otherwise.log.events)
    assert (twin.stale, noticed(twin)) == (cut_otherwise.stale, noticed(cut_otherwise))


def noticed(twin):
    """The counts of notices. Channels whose clocks make one step share a notice if they do so in one batch."""
    return {key: min(count, 1) if key == CLOCK_MOVED else count for key, count in twin.counts.items()}


def said_of(events):
    """What was said, whatever time it was stamped with: that of a clock that was set is moved."""
    rows = zip(events.arrival, events.kind, events.channel, events.value, strict=True)
    return Counter((int(at), int(kind), int(channel), value.tobytes()) for at, kind, channel, value in rows)
