"""Isolate the most likely faulty sensor, input or parameter behind each open episode of the running twin.

Sensor, input and parameter faults may look alike. Each is refolded with the last events, as a background job: soon
after an episode has begun, and again whenever it lasts twice as long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from typing import NamedTuple

from estimators.diagnostics.detectors import detector_of
from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.sensitivity.responses import DRIFT, SENSOR
from estimators.diagnostics.sensitivity.suspects import in_words, likeliest, suspects
from estimators.errors import NisusError

from .integrity import reason_against
from .jobs import Job, PacedExecutor
from .notices import Notices
from .outputs import EventWindow

CHECK_PERIOD_S = 1.0
"""Seconds between two checks of the open episodes."""

MIN_EPISODE_S = 3.0
"""Duration of an episode from which its cause can be isolated."""


class _Isolated(NamedTuple):
    """Outcome for an episode that had lasted so long: the fault in words, and its sensor row, if it is one."""

    lasted: float
    words: str = ""
    row: str = ""


class RootCause:
    """Most likely fault behind each open episode, by the episode's subject.

    Args:
        episodes: Returns the present episodes.
        take: Returns a copy of the last events, or None where there is none.
        notices: Receives a finding, once.
    """

    def __init__(
        self, episodes: Callable[[], Sequence[Episode]], take: Callable[[], EventWindow | None], notices: Notices
    ) -> None:
        self._episodes, self._take, self._notices = episodes, take, notices
        self._found: dict[str, _Isolated] = {}

    def fault_behind(self, episode: Episode) -> str:
        """Return the most likely fault behind an episode; "" if it is not known."""
        return self._found[episode.subject].words if _is_open(episode) and episode.subject in self._found else ""

    def with_fault(self, episode: Episode) -> Episode:
        """Return the episode with the most likely fault in its text."""
        words = self.fault_behind(episode)
        return episode._replace(text=f"{episode.text}; most likely off: {words}") if words else episode

    def primary(self, episode: Episode) -> Episode:
        """Return the open episode of the sensor that is most likely faulty in this one; this one if it is its own.

        A filter follows a biased sensor, so that in time consistent sensors contradict it.
        """
        row = self._found[episode.subject].row if _is_open(episode) and episode.subject in self._found else None
        return next((other for other in self._episodes() if _is_open(other) and other.subject == row), episode)

    def update(self, job: Job) -> None:
        """Isolate the faults of the open episodes that have grown enough."""
        opened = [episode for episode in self._episodes() if _is_open(episode)]
        subjects = {episode.subject for episode in opened}
        self._found = {subject: found for subject, found in self._found.items() if subject in subjects}
        taken = self._take() if opened else None
        if taken is None or reason_against(taken.tuning.model, taken.estimator):
            return
        now, begun = taken.end * 1e-9, -inf if taken.base is None else taken.base.clock * 1e-9
        for episode in opened:
            lasted, known = now - episode.start, self._found.get(episode.subject, _Isolated(0.0))
            if lasted < max(MIN_EPISODE_S, 2.0 * known.lasted) or episode.start < begun:
                continue
            self._found[episode.subject] = known._replace(lasted=lasted)
            self._isolate(episode, taken, job)

    def _isolate(self, episode: Episode, taken: EventWindow, job: Job) -> None:
        try:
            found = suspects(
                taken.estimator, taken.tuning.model, taken.tuning, taken.log(), episode.start,
                base=taken.base, executor=PacedExecutor(job),
            )  # fmt: skip
        except NisusError:
            return
        words, known = in_words(found), self._found[episode.subject]
        if words:
            first = likeliest(found)[0].nudge
            row = first.name if first.kind in (SENSOR, DRIFT) else ""
            self._found[episode.subject] = known._replace(words=words, row=row)
            if not known.words:
                text = f"{episode.subject}: most likely off: {words}"
                self._notices.say(text, level="warn", t=int(taken.events.t[-1]))


def _is_open(episode: Episode) -> bool:
    return episode.end is None and detector_of(episode.cause).isolate
