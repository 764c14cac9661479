"""All episodes of a fold: a pure function of its events and its track."""

from __future__ import annotations

from .course import Course, Folded, course_of
from .episode import Episode, Found
from .sensors import of_sensors
from .silence import of_silence
from .states import of_ranges, of_truth
from .twin import of_particles, of_twin

KINDS = (of_sensors, of_silence, of_truth, of_ranges, of_particles, of_twin)
"""What is looked at, one after the other."""


def episodes(fold: Folded) -> list[Episode]:
    """All episodes of a fold, in the order of their start."""
    return [item.episode for item in found_in(course_of(fold))]


def found_in(course: Course) -> list[Found]:
    """All episodes of a stretch of events, in the order of their start."""
    found = [item._replace(episode=_plain(item.episode)) for kind in KINDS for item in kind(course)]
    return sorted(found, key=lambda item: (item.episode.start, item.episode.subject))


def _plain(episode: Episode) -> Episode:
    """With numbers of Python, whatever they came from."""
    end = None if episode.end is None else float(episode.end)
    start, size, low, high = (float(x) for x in (episode.start, episode.size, episode.low, episode.high))
    return episode._replace(start=start, end=end, size=size, low=low, high=high)
