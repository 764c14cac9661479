"""What stands between a source and the log, for the running twin and for a fold of a file alike."""

from __future__ import annotations

import numpy as np

from estimators.events.clocks import ClockGuard, Moved, Passed, Refused
from estimators.log import INPUT, READING, Events
from estimators.model.state_space import StateSpaceModel
from sources.source import Report

WRONG_TIME = "wrong time"
"""Key of events that are refused for their time."""

CLOCK_MOVED = "clock moved"
"""Key of a source's clock that was set."""


class Intake:
    """Judges the time of what a source says, and tells what was refused or set right."""

    def __init__(self, model: StateSpaceModel, horizon: int | None, report: Report) -> None:
        """`horizon`: the log's, ns; None is a recording's log, which was judged when it was recorded."""
        self._model, self._report = model, report
        self._guard = None if horizon is None else ClockGuard(len(model.sensors), horizon)

    @property
    def held(self) -> int:
        """Events that wait for the next to tell whether their time is true."""
        return 0 if self._guard is None else self._guard.held

    def take(self, batch: Events) -> Passed:
        """What of the next events, in the order of arrival, may go to the log."""
        if self._guard is None:
            return Passed(batch, np.zeros(len(batch), np.bool_), [], [])
        return self._told(self._guard.take(batch))

    def finish(self) -> Passed:
        """What is left at the end of the source."""
        if self._guard is None:
            return Passed(Events.empty(self._model.width), np.zeros(0, np.bool_), [], [])
        return self._told(self._guard.finish())

    def _told(self, passed: Passed) -> Passed:
        for refused in passed.refused:
            self._report(WRONG_TIME, self._refusal(refused))
        for moved in passed.moved:
            self._report(CLOCK_MOVED, self._move(moved))
        return passed

    def _named(self, kind: int, channel: int) -> str:
        if kind == READING:
            return self._model.sensors[channel].name
        return "the inputs" if kind == INPUT else "the true states"

    def _refusal(self, refused: Refused) -> str:
        ahead = (refused.t - refused.expected) * 1e-9
        return (
            f"{self._named(refused.kind, refused.channel)}: its time, {refused.t * 1e-9:.9g} s, is {ahead:.6g} s after "
            "the newest, and what came next does not agree; refused"
        )

    def _move(self, moved: Moved) -> str:
        by = f"{abs(moved.by) * 1e-9:.6g} s {'ahead' if moved.by > 0 else 'back'}"
        return (
            f"{self._named(moved.kind, moved.channel)}: its clock was set {by} at {moved.t * 1e-9:.9g} s; times from "
            "there on are corrected by it (if the rows are out of order, sort them by time)"
        )
