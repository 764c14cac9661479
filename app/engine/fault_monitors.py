"""Jobs that fold the last events again to assess faults: root causes of open episodes, and protection levels.

Sensor, input and parameter faults may look alike, so each is refolded: soon after an episode has begun, and again
whenever it lasts twice as long. Protection levels say how large an undetectable error of each state may be; those of a
new revision are computed soon, those of one that goes on now and then (estimators/diagnostics/sensitivity).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from math import inf
from typing import NamedTuple

from estimators.diagnostics.detectors import detector_of
from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.sensitivity import bounds_of, sensitivity, smallest_of
from estimators.diagnostics.sensitivity.responses import SENSOR
from estimators.diagnostics.sensitivity.suspects import in_words, isolates, likeliest, suspects
from estimators.errors import NisusError
from estimators.model.state_space import StateSpaceModel
from estimators.registry import find_entry

from .copies import EventWindow, ProtectionLevels
from .jobs import Job, JobCancelled, PacedExecutor
from .notices import Notices

ROOT_CAUSE_PERIOD_S = 1.0
"""Seconds between two checks of the open episodes."""

MIN_EPISODE_S = 3.0
"""Duration of an episode from which its cause can be isolated."""

MIN_MOVED = 0.1  # Standard deviations by which an error of a sensor moves a state that it affects

LEVELS_PERIOD_S = 15.0
"""Seconds between two looks for new events."""

LEVELS_CPU_SHARE = 0.01
"""Share of one processor that the levels of one revision may take; more expensive ones are computed less often."""


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
        levels: Has the states that each sensor does not affect.
    """

    def __init__(
        self,
        episodes: Callable[[], Sequence[Episode]],
        take: Callable[[], EventWindow | None],
        notices: Notices,
        levels: ProtectionMonitor,
    ) -> None:
        self._episodes, self._take, self._notices, self._levels = episodes, take, notices, levels
        self._found: dict[str, _Isolated] = {}

    def fault_behind(self, episode: Episode) -> str:
        """Return the most likely fault behind an episode; "" if it is not known."""
        return self._found[episode.subject].words if _is_open(episode) and episode.subject in self._found else ""

    def with_fault(self, episode: Episode) -> Episode:
        """Return the episode with the most likely fault and, while it lasts, the states not affected, in its text."""
        words = self.fault_behind(episode)
        text = f"{episode.text}; most likely fault: {words}" if words else episode.text
        # A state may have the name of a sensor, and episodes without alarms: of a state that is wrong itself.
        wrong = {each.subject for each in self._episodes() if each.end is None and not detector_of(each.cause).alarms}
        known = self._levels.unaffected.get(episode.subject, ()) if detector_of(episode.cause).alarms else ()
        unaffected = ", ".join(name for name in known if name not in wrong)
        return episode._replace(text=f"{text}; not affected: {unaffected}" if unaffected and not episode.end else text)

    def primary(self, episodes: Sequence[Episode]) -> Episode:
        """Return the one of the sensor that is most likely faulty in the first, or the first.

        A filter follows a biased sensor, so that in time consistent sensors contradict it.
        """
        first = episodes[0]
        row = self._found[first.subject].row if _is_open(first) and first.subject in self._found else None
        return next((other for other in episodes if other.subject == row), first)

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
            kind, name = next((item.nudge.target for item in likeliest(found)), ("", ""))
            row = name if kind == SENSOR else ""
            self._found[episode.subject] = known._replace(words=words, row=row)
            if not known.words:
                text = f"{episode.subject}: most likely fault: {words}"
                self._notices.say(text, level="warn", t=int(taken.events.t[-1]))


def _is_open(episode: Episode) -> bool:
    return episode.end is None and isolates(episode.cause)


class ProtectionMonitor:
    """Computes the protection levels again and again."""

    def __init__(self, take: Callable[[], EventWindow | None], false_alarm: float) -> None:
        """Prepare.

        Args:
            take: Gives a copy of the last events; None while there are none, or a refold is under way.
            false_alarm: Mean time between false alarms of the detectors, s.
        """
        self._take, self._false_alarm = take, false_alarm
        self.unaffected: dict[str, list[str]] = {}
        """States that errors of each sensor row do not affect: a lasting one of its σ moves them by less than
        `MIN_MOVED` of theirs."""
        self._latest: ProtectionLevels | None = None
        self._due = 0.0

    def of(self, revision: int) -> ProtectionLevels | None:
        """Return the latest levels if they are of this revision."""
        latest = self._latest
        return latest if latest is not None and latest.revision == revision else None

    def update(self, job: Job) -> None:
        """Compute the levels, unless they are recent enough or no event has come."""
        taken = self._take()
        if taken is None:
            return
        known, begun = self.of(taken.revision), time.thread_time()
        if known is not None and (time.monotonic() < self._due or known.t == taken.end):
            return
        self._latest = self._compute(taken, job)
        self._due = time.monotonic() + (time.thread_time() - begun) / LEVELS_CPU_SHARE

    def _compute(self, taken: EventWindow, job: Job) -> ProtectionLevels:
        # The model of the fold: the twin's files may have been saved since.
        model = taken.tuning.model
        if reason := reason_against(model, taken.estimator):
            return ProtectionLevels(taken.revision, taken.end, reason)
        try:
            found = sensitivity(
                taken.estimator,
                model,
                taken.tuning,
                taken.log(),
                base=taken.base,
                false_alarm=self._false_alarm,
                executor=PacedExecutor(job),
            )
        except JobCancelled:
            raise
        except Exception as error:  # noqa: BLE001  a user's model may raise anything; the status shows the reason
            return ProtectionLevels(taken.revision, taken.end, f"{type(error).__name__}: {error}")
        self.unaffected = {
            fault.nudge.name: [
                state.name
                for state, moved, std in zip(model.shown_states, fault.response.states[-1], found.std[-1], strict=True)
                if state.watched and abs(moved) * fault.nudge.scale < MIN_MOVED * std
            ]
            for fault in found.faults
            if fault.nudge.kind == SENSOR
        }
        return ProtectionLevels(taken.revision, taken.end, found.reason, bounds_of(model, found), smallest_of(found))


def reason_against(model: StateSpaceModel, estimator: str) -> str:
    """Return why nudges of this twin are not folded beside it; empty if they are. Sizes `sensitivity` checks itself."""
    if model.black_box:
        return f"{model.name} is a black box, which is too slow to be folded again all the time; see nisus check"
    if find_entry(estimator).samples:
        return f"{estimator} draws at random, and its nudges would be noise; see nisus check"
    return ""
