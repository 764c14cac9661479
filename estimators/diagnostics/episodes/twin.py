"""Episodes of the twin as a whole: an impoverished cloud, no readings, a lost estimate."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...log import READING
from ...track import DIVERGED, GATED, HEALTH_NAMES, SCREENED, STALE
from .. import words
from ..detectors import IMPOVERISHED, REFUSED, SHIFTED_DOWN, SHIFTED_UP, STUCK
from .course import Course, runs
from .episode import Episode, Found

OFF = REFUSED | STUCK | SHIFTED_UP | SHIFTED_DOWN
"""Alarms of a sensor that speaks against the estimate."""


def of_particles(course: Course) -> Iterator[Found]:
    """A cloud of which a few particles carry the estimate."""
    t, track = course.events.t, course.track
    for run in runs(track.flags & IMPOVERISHED != 0):
        effective = track.effective[run.begin : run.end]
        effective = effective[np.isfinite(effective)]
        if not effective.size:
            continue
        start, size = run.start(t), float(np.median(effective))
        low, high = (float(np.quantile(effective, share)) for share in (0.025, 0.975))
        text = words.of_particles(size, float(np.nanmin(track.ancestors[run.begin : run.end])), start)
        episode = Episode(
            start=start,
            end=run.over(t),
            subject="twin",
            cause="impoverished",
            size=size,
            low=low,
            high=high,
            unit="",
            text=text,
        )
        yield Found(("particles", "twin"), run.begin, int(t[run.begin]), episode)


def sensors_off(course: Course, end: int) -> list[str]:
    """Sensors in use whose last reading before row `end` is refused, or in an alarm of refusal, shift or repetition."""
    channel, track = course.events.channel, course.track
    off = []
    for s, sensor in enumerate(course.model.sensors):
        rows = np.flatnonzero((course.events.kind[:end] == READING) & (channel[:end] == s))
        if not rows.size or not course.tuning.used[s]:
            continue
        last = rows[-1]
        said = int(np.bitwise_or.reduce(track.alarms[last, : len(sensor.rows)]))
        if track.verdict[last] in (GATED, SCREENED) or said & OFF:
            off.append(sensor.name)
    return off


def of_twin(course: Course) -> Iterator[Found]:
    """A twin that is stale, or diverged."""
    t, track = course.events.t, course.track
    for code in (STALE, DIVERGED):
        for run in runs(track.health == code):
            start, cause = run.start(t), HEALTH_NAMES[code]
            if code == STALE:
                start -= float(track.age[run.begin])
            size = (t[run.end - 1] - t[run.begin]) * 1e-9
            if code == STALE:
                text = words.of_stale(start)
            else:
                text = words.of_loss(start, sensors_off(course, run.end), len(course.model.sensors))
            episode = Episode(start, run.over(t), "twin", cause, size, np.nan, np.nan, "s", text)
            yield Found(("twin", cause), run.begin, int(t[run.begin]), episode)
