"""Episodes of faults: subject, cause, start, end, size and remedy."""

from .episode import JOINED, Episode, FoundEpisode, JudgedRows, episode_json, standardised
from .sensors import ALARM_KEYS, LOSSES
from .tracker import EpisodeTracker, TrackedEpisode, episodes, episodes_of, found_in, judged_rows

__all__ = [
    "ALARM_KEYS", "JOINED", "LOSSES", "Episode", "EpisodeTracker", "FoundEpisode", "JudgedRows",
    "TrackedEpisode", "episode_json", "episodes", "episodes_of", "found_in", "judged_rows", "standardised",
]  # fmt: skip
