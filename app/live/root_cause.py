"""Who is most likely off, while the twin runs: for each open episode, in a thread that is never in the engine's way.

A shift may be the fault of a sensor, an input or a parameter. Which of them explains best what was seen takes a refold
for each (estimators/diagnostics/sensitivity/suspects.py); it is asked soon after an episode has begun, and again
whenever twice as much has been seen of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf

from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.sensitivity.responses import DRIFT, SENSOR
from estimators.diagnostics.sensitivity.suspects import RIDDLES, in_words, likeliest, suspects
from estimators.errors import NisusError

from .integrity import reason_against
from .jobs import Job, PacedExecutor
from .notices import Notices
from .outputs import EventWindow

EVERY = 1.0
"""Seconds between two looks at the open episodes."""

SOON = 3.0
"""Seconds of an episode from which on it can be asked."""


class Blame:
    """Whoever may be to blame for each open episode, by its subject."""

    def __init__(
        self,
        episodes: Callable[[], Sequence[Episode]],
        take: Callable[[], EventWindow | None],
        notices: Notices,
    ) -> None:
        """Prepare.

        Args:
            episodes: Gives those known now.
            take: Gives a copy of the last events, or None if now is not the time.
            notices: Where a finding is said, once.
        """
        self._episodes, self._take, self._notices = episodes, take, notices
        self._words: dict[str, str] = {}
        self._rows: dict[str, str] = {}
        self._seen: dict[str, float] = {}

    def of(self, episode: Episode) -> str:
        """Who is most likely off, in words; nothing if it is not known."""
        return self._words.get(episode.subject, "") if _riddle(episode) else ""

    def told(self, episode: Episode) -> Episode:
        """The episode, with who is most likely off in its text."""
        words = self.of(episode)
        return episode._replace(text=f"{episode.text}; most likely off: {words}") if words else episode

    def behind(self, episode: Episode) -> Episode:
        """The open episode of the sensor that is most likely off in this one, if that is another's; else this one.

        A filter follows a sensor that is off, so that in time those that are in order contradict it.
        """
        row = self._rows.get(episode.subject) if _riddle(episode) else None
        return next((other for other in self._episodes() if _riddle(other) and other.subject == row), episode)

    def look(self, job: Job) -> None:
        """Ask for the open episode of which most is new."""
        riddles = [episode for episode in self._episodes() if _riddle(episode)]
        subjects = {episode.subject for episode in riddles}
        self._words = {subject: words for subject, words in self._words.items() if subject in subjects}
        self._rows = {subject: row for subject, row in self._rows.items() if subject in subjects}
        self._seen = {subject: seen for subject, seen in self._seen.items() if subject in subjects}
        taken = self._take() if riddles else None
        if taken is None or reason_against(taken.tuning.model, taken.estimator):
            return
        now, begun = taken.end * 1e-9, -inf if taken.base is None else taken.base.clock * 1e-9
        for episode in riddles:
            lasted = now - episode.start
            if lasted < max(SOON, 2.0 * self._seen.get(episode.subject, 0.0)) or episode.start < begun:
                continue
            self._seen[episode.subject] = lasted
            self._ask(episode, taken, job)

    def _ask(self, episode: Episode, taken: EventWindow, job: Job) -> None:
        model = taken.tuning.model
        log, executor = taken.log(), PacedExecutor(job)
        try:
            found = suspects(
                taken.estimator, model, taken.tuning, log, episode.start, base=taken.base, executor=executor
            )
        except NisusError:
            return
        words, before = in_words(found), self.of(episode)
        if words:
            self._words[episode.subject] = words
            first = likeliest(found)[0].nudge
            self._rows[episode.subject] = first.name if first.kind in (SENSOR, DRIFT) else ""
            if not before:
                self._notices.say(
                    f"{episode.subject}: most likely off: {words}", level="warn", t=int(taken.events.t[-1])
                )


def _riddle(episode: Episode) -> bool:
    return episode.end is None and episode.cause in RIDDLES
