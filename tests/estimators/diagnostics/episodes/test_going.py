"""Episodes whose rows are forgotten piece by piece end where those of the whole fold do."""

import numpy as np
import pytest

from estimators.diagnostics.effects import KINDS, gains
from estimators.diagnostics.episodes import JOINED, Going, course_of, found_in
from estimators.log import READING
from tests.estimators.diagnostics.episodes.test_find import SENSORS, folded


@pytest.mark.parametrize("cause", KINDS)
def test_sums_take_the_place_of_what_is_forgotten(cause):
    e = np.random.default_rng(3).standard_normal(300) * np.where(np.arange(300) % 40, 1.3, 5.0)
    whole, sums = gains(e, cause)
    parts, run = [], gains(e[:0], cause)[1]
    for piece in np.split(e, [1, 2, 90, 90, 203]):
        gain, run = gains(piece, cause, run)
        parts.append(gain)
    # Sums of 300 numbers in another order.
    np.testing.assert_allclose(np.concatenate(parts), whole, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(run, sums, rtol=1e-12)


@pytest.mark.parametrize("cause", SENSORS)
def test_the_end_is_that_of_the_whole(cause):
    course = course_of(folded(**SENSORS[cause][0]))
    subject = SENSORS[cause][1][0]
    (found,) = (item for item in found_in(course) if item.episode.subject.startswith(subject))
    going = Going()
    for start in range(0, len(course.track), 501):
        rows = slice(start, start + 501)
        piece = course._replace(events=course.events.select(rows), track=course.track.select(rows))
        going = going.over(piece, found.key[1], found.episode, found.at)
    assert max(going.end, found.at * 1e-9) == pytest.approx(found.episode.end, abs=1e-6)
    # The readings since the last alarm: it is over.
    s = course.model.sensor_names.index(found.key[1])
    own = np.flatnonzero((course.events.kind == READING) & (course.events.channel == s))
    assert going.quiet == own.size - 1 - np.flatnonzero(course.track.alarms[own].any(axis=1))[-1] > JOINED
