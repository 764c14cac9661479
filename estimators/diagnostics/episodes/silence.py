"""Episodes in which a sensor says nothing: since its last reading, until the next."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...log import READING
from .. import words
from ..detectors import SENSOR_FLAGS
from .course import Course, runs
from .episode import Episode, Found


def of_silence(course: Course) -> Iterator[Found]:
    """Silent sensors, as far as they have a bit of their own."""
    events, model, flags = course.events, course.model, course.track.flags
    t = events.t
    if not flags.any():
        return
    for s, sensor in enumerate(model.sensors[:SENSOR_FLAGS]):
        heard = np.flatnonzero((events.kind == READING) & (events.channel == s))
        known = 0 if course.heard is None else int(course.heard[s])
        for run in runs(flags >> s & 1 != 0):
            before = heard[heard < run.begin]
            last = int(t[before[-1]]) if before.size else known
            cause = "silent" if last else "never heard"
            start, over = (last or int(t[0])) * 1e-9, run.over(t)
            size = (t[run.end - 1] * 1e-9 if over is None else over) - start
            text = words.of_silence(model, s, cause, start, None if run.lasts else size)
            episode = Episode(start, over, sensor.name, cause, size, np.nan, np.nan, "s", text)
            yield Found(("silence", sensor.name), run.begin, int(t[run.begin]), episode)
