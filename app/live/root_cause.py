"""Who is most likely off, while the twin runs: for each open episode, in a thread that is never in the engine's way.

A shift may be the fault of a sensor, an input or a parameter. Which of them explains best what was seen takes a refold
for each (estimators/diagnostics/sensitivity/suspects.py); it is asked soon after an episode has begun, and again
whenever twice as much has been seen of it.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Sequence

from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.sensitivity.responses import DRIFT, SENSOR
from estimators.diagnostics.sensitivity.suspects import RIDDLES, in_words, likeliest, suspects
from estimators.errors import NisusError
from estimators.log import Log

from .integrity import LOWEST, Stopped, Unhurried, Window, reason_against
from .notices import Notices

EVERY = 1.0
"""Seconds between two looks at the open episodes."""

SOON = 3.0
"""Seconds of an episode from which on it can be asked."""


class Blame:
    """Whoever may be to blame for each open episode, by its subject."""

    def __init__(
        self,
        episodes: Callable[[], Sequence[Episode]],
        take: Callable[[], Window | None],
        notices: Notices,
        *,
        every: float = EVERY,
    ) -> None:
        """Prepare.

        Args:
            episodes: Gives those known now.
            take: Gives a copy of the last events, or None if now is not the time.
            notices: Where a finding is said, once.
            every: Seconds between two looks.
        """
        self._episodes, self._take, self._notices, self._every = episodes, take, notices, every
        self._words: dict[str, str] = {}
        self._rows: dict[str, str] = {}
        self._seen: dict[str, float] = {}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="blame", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End after the fold that is under way."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=1.0)

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

    def look(self) -> None:
        """Ask for the open episode of which most is new."""
        riddles = [episode for episode in self._episodes() if _riddle(episode)]
        subjects = {episode.subject for episode in riddles}
        self._words = {subject: words for subject, words in self._words.items() if subject in subjects}
        self._rows = {subject: row for subject, row in self._rows.items() if subject in subjects}
        self._seen = {subject: seen for subject, seen in self._seen.items() if subject in subjects}
        taken = self._take() if riddles else None
        if taken is None or reason_against(taken.tuning.model, taken.estimator):
            return
        now, begun = taken.events.t[-1] * 1e-9, taken.base.clock * 1e-9
        for episode in riddles:
            lasted = now - episode.start
            if lasted < max(SOON, 2.0 * self._seen.get(episode.subject, 0.0)) or episode.start < begun:
                continue
            self._seen[episode.subject] = lasted
            self._ask(episode, taken)

    def _ask(self, episode: Episode, taken: Window) -> None:
        model = taken.tuning.model
        log = Log.resume(model, taken.base, taken.events)
        executor = Unhurried(self._stopping)
        try:
            found = suspects(
                taken.estimator, model, taken.tuning, log, episode.start, base=taken.base, executor=executor
            )
        except (NisusError, Stopped):
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

    def _run(self) -> None:
        if sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOWEST)
        while not self._stopping.wait(self._every):
            try:
                self.look()
            except Exception as error:  # noqa: BLE001  a user's model may raise anything; the twin goes on
                self._notices.report("blame", f"{type(error).__name__}: {error}", level="error", counted=False)


def _riddle(episode: Episode) -> bool:
    return episode.end is None and episode.cause in RIDDLES
