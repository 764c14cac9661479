"""Episodes: what was wrong from when to when, with whom, by how much, and what can be done about it."""

from .course import JOINED, Course, Folded, course_of, standardised
from .episode import CAUSES, Episode, Found, anchor, episode_json
from .find import episodes, found_in
from .going import ANY, Going
from .sensors import LOSSES

__all__ = [
    "ANY",
    "CAUSES",
    "JOINED",
    "LOSSES",
    "Course",
    "Episode",
    "Folded",
    "Found",
    "Going",
    "anchor",
    "course_of",
    "episode_json",
    "episodes",
    "found_in",
    "standardised",
]
