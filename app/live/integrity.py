"""Protection levels of the running twin: how large an undetectable error of each state may be.

A job copies the last events now and then and folds them again for each nudge (estimators/diagnostics/sensitivity).
Another revision is looked at soon; the levels of one that goes on change slowly and are computed only now and then.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from estimators.diagnostics.sensitivity import bounds_of, sensitivity, smallest_of
from estimators.model.state_space import StateSpaceModel
from estimators.registry import find_entry

from .jobs import Job, JobCancelled, PacedExecutor
from .outputs import EventWindow, ProtectionLevels

PERIOD_S = 15.0
"""Seconds between two looks for new events."""

CPU_SHARE = 0.01
"""Share of one processor that the levels of one revision may take; more expensive ones are computed less often."""


class ProtectionMonitor:
    """Computes the protection levels again and again."""

    def __init__(self, take: Callable[[], EventWindow | None], false_alarm: float) -> None:
        """Prepare.

        Args:
            take: Gives a copy of the last events; None while there are none, or a refold is under way.
            false_alarm: Mean time between false alarms of the detectors, s.
        """
        self._take, self._false_alarm = take, false_alarm
        self._latest: ProtectionLevels | None = None
        self._due = 0.0

    def of(self, revision: int) -> ProtectionLevels | None:
        """Return the latest levels if they are of this revision."""
        latest = self._latest
        return latest if latest is not None and latest.revision == revision else None

    def look(self, job: Job) -> None:
        """Compute the levels, unless they are recent enough or no event has come."""
        taken = self._take()
        if taken is None:
            return
        known, begun = self.of(taken.revision), time.thread_time()
        if known is not None and (time.monotonic() < self._due or known.t == taken.end):
            return
        self._latest = self._compute(taken, job)
        self._due = time.monotonic() + (time.thread_time() - begun) / CPU_SHARE

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
        return ProtectionLevels(taken.revision, taken.end, found.reason, bounds_of(model, found), smallest_of(found))


def reason_against(model: StateSpaceModel, estimator: str) -> str:
    """Return why nudges of this twin are not folded beside it; empty if they are. Sizes `sensitivity` checks itself."""
    if model.black_box:
        return f"{model.name} is a black box, which is too slow to be folded again all the time; see nisus check"
    if find_entry(estimator).family in ("particle", "ensemble"):
        return f"{estimator} draws at random, and its nudges would be noise; see nisus check"
    return ""
