"""What stands between a source and the log, for the running twin and for a fold of a file alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estimators.events.clocks import ClockGuard, Moved, Passed, Refused
from estimators.events.maintenance import maintained
from estimators.log import INPUT, READING, Events
from estimators.model.state_space import StateSpaceModel
from sources.source import WRONG_TIME, Report

CLOCK_MOVED = "clock moved"
"""Key of a source's clock that was set."""

MAINTENANCE = "maintenance"
"""Key of a maintenance that the YAML tells of."""


class Planned(NamedTuple):
    """A maintenance that the YAML tells of: its time (ns), what was changed, and the indices of the states."""

    at: int
    what: str
    states: tuple[int, ...]


def maintenance_text(what: str, states: Sequence[int], model: StateSpaceModel) -> str:
    """What is said of a maintenance."""
    names = [model.state_names[k] for k in states]
    shown = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
    return f"maintenance: {what}; {shown} as uncertain as at the start, and a new version of the model begins"


class Intake:
    """Judges the time of what a source says, and tells what was refused or set right."""

    def __init__(
        self, model: StateSpaceModel, horizon: int | None, report: Report, planned: Sequence[Planned] = ()
    ) -> None:
        """What comes from a source of this model.

        Args:
            model: The model.
            horizon: The log's, ns; None is a recording's log, which was judged when it was recorded.
            report: Told of what is refused or set right, and of maintenance.
            planned: Maintenance that the YAML tells of; a recording's log has it already.
        """
        self._model, self._report = model, report
        self._guard = None if horizon is None else ClockGuard(len(model.sensors), horizon)
        self._planned = [] if horizon is None else sorted(planned, key=lambda item: item.at)

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
        for by in dict.fromkeys(moved.by for moved in passed.moved):
            self._report(CLOCK_MOVED, self._move([moved for moved in passed.moved if moved.by == by]))
        while self._planned and len(passed.events) and self._planned[0].at <= passed.events.t.max():
            passed = self._maintain(passed, self._planned.pop(0))
        return passed

    def _maintain(self, passed: Passed, item: Planned) -> Passed:
        """With a maintenance whose time has come."""
        model = self._model
        events = maintained(item.at, item.at, item.states, model.width)
        self._report(MAINTENANCE, maintenance_text(item.what, item.states, model))
        settled = np.concatenate((passed.settled, np.ones(len(events), np.bool_)))
        return passed._replace(events=Events.concat([passed.events, events], model.width), settled=settled)

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

    def _move(self, moved: Sequence[Moved]) -> str:
        """Return the line for channels whose clock made one step; all of one source share its clock."""
        by, begun = moved[0].by * 1e-9, min(item.t for item in moved) * 1e-9
        names = [self._named(item.kind, item.channel) for item in moved]
        named = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
        whose, where = "its" if len(names) == 1 else "their", "ahead" if by > 0 else "back"
        return (
            f"{named}: {whose} clock was set {abs(by):.6g} s {where} at {begun:.9g} s; times from there on are "
            "corrected by it (if the rows are out of order, sort them by time)"
        )
