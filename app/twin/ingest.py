"""Check the times of events between a source and the log; add planned maintenance, pauses and predictions in gaps."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.detectors import detector_of
from estimators.diagnostics.episodes import Episode
from estimators.errors import spaced
from estimators.events.arrays import blank
from estimators.events.clocks import ClockGuard, Moved, Passed, Refused
from estimators.events.maintenance import maintained
from estimators.log import BEFORE, INPUT, READING, TICK, Events
from estimators.model.state_space import StateSpaceModel
from sources.source import WRONG_TIME, Report

from ..result import JsonObject

CLOCK_MOVED = "clock moved"  # key of jumps of a source's clock
MAINTENANCE = "maintenance"  # key of maintenance
PAUSED = "paused"  # key of pauses of a source, over which inputs are unknown
UNSET = "input without value"  # key of inputs whose first value comes late
MAX_UNSET_S = 3.0  # seconds after the first event for which an input may have no value
PAUSE_PERIODS = 3.0  # median periods of a source beyond which a gap may be a pause: some log once a minute
GAP_PERIODS = 10.0  # the same beyond which predictions are shown in a gap of a recording
GAP_QUERIES = 20  # predictions in a gap
PERIODS = 20  # latest periods of which the median is taken


class Planned(NamedTuple):
    """Maintenance by the YAML: its time (ns), description, and the indices of the states."""

    at: int
    what: str
    states: tuple[int, ...]


class UnknownInputs(NamedTuple):
    """Time without any event after which the inputs of a pause are unknown, ns, and the indices of driven states."""

    after: int
    states: tuple[int, ...]


def maintenance_text(what: str, states: Sequence[int], model: StateSpaceModel) -> str:
    """Return the notice of a maintenance."""
    return f"maintenance: {what}; {_restarted(states, model)}, and a new version of the model begins"


def _restarted(states: Sequence[int], model: StateSpaceModel) -> str:
    names = [model.state_names[k] for k in states]
    return ", ".join(names[:6]) + (", ..." if len(names) > 6 else "") + " as uncertain as at the start"


class Ingest:
    """Accepts, corrects or rejects the times of a source's events, and reports each change."""

    def __init__(
        self,
        model: StateSpaceModel,
        horizon: int | None,
        report: Report,
        planned: Sequence[Planned] = (),
        unknown: UnknownInputs | None = None,
        utc: bool = False,
        gap: int | None = None,
    ) -> None:
        """Prepare for a source of this model.

        Args:
            model: The model.
            horizon: The log's, ns; None is a recording's log, which was judged when it was recorded.
            report: Receives rejections, corrections and maintenance.
            planned: Maintenance by the YAML; a recording's log contains it already.
            unknown: Pauses over which the inputs are unknown, by the YAML; a recording's log contains them already.
            utc: See `ClockGuard`.
            gap: Time without any event after which the predictions of meanwhile are shown, ns, None for never: a
                recording's log contains them already, and those of a live source come as time goes by.
        """
        self._model, self._report = model, report
        self._guard = None if horizon is None else ClockGuard(len(model.sensors), horizon, utc)
        self._planned = [] if horizon is None else sorted(planned, key=lambda item: item.at)
        self._unknown = None if horizon is None else unknown
        self._gap = None if horizon is None else gap
        self._newest = BEFORE
        self._first, self._unset = np.iinfo(np.int64).max, {*range(model.nu)}
        self._periods = deque[int](maxlen=PERIODS)

    @property
    def held(self) -> int:
        """Number of events held until the next one confirms their time."""
        return 0 if self._guard is None else self._guard.held

    def came(self, events: Events) -> tuple[np.ndarray, np.ndarray]:
        """Return the arrivals of events (n,) that have passed, and of all that are held, ns, as they came."""
        guard = self._guard
        return (
            (events.arrival, events.arrival[:0]) if guard is None else (events.arrival - guard.set_back, guard.waiting)
        )

    def state(self) -> JsonObject:
        """Return a copy of the state for `restore`, of arrays, lists and numbers."""
        guard = None if self._guard is None else self._guard.state()
        return {"newest": self._newest, "periods": [*self._periods], "guard": guard}

    def restore(self, state: JsonObject, newest: int) -> None:
        """Continue from the `state` of another; `newest` is the time of the log's newest event, ns.

        Raises:
            ValueError: If it is of another model.
        """
        self._newest = int(state["newest"])
        self._unset.clear()
        self._periods.extend(state["periods"])
        self._planned = [item for item in self._planned if item.at > newest]
        if self._guard is not None and state["guard"] is not None:
            self._guard.restore(state["guard"])

    def take(self, batch: Events) -> Passed:
        """Return those of the next events, in order of arrival, that enter the log."""
        if self._guard is None:
            return Passed(batch, np.zeros(len(batch), np.bool_), [], [])
        return self._reported(self._guard.take(batch))

    def finish(self) -> Passed:
        """Return the events that are held at the end of the source."""
        if self._guard is None:
            return Passed(Events.empty(self._model.width), np.zeros(0, np.bool_), [], [])
        return self._reported(self._guard.finish())

    def _reported(self, passed: Passed) -> Passed:
        for refused in passed.refused:
            self._report(WRONG_TIME, refusal(self._named(refused.kind, refused.channel), refused))
        for line in clock_lines(passed.moved, lambda item: self._named(item.kind, item.channel)):
            self._report(CLOCK_MOVED, line)
        while self._planned and len(passed.events) and self._planned[0].at <= passed.events.t.max():
            item = self._planned.pop(0)
            self._report(MAINTENANCE, maintenance_text(item.what, item.states, self._model))
            passed = self._restart(passed, item.at, item.states)
        self._tell_unset(passed.events)
        return passed if self._unknown is None and self._gap is None else self._paused(passed)

    def _tell_unset(self, events: Events) -> None:
        """Report the inputs that now have their first value, and had none for a while."""
        self._first = int(events.t.min(initial=self._first))
        inputs = events.select(events.kind == INPUT)
        known = np.isfinite(inputs.value)
        for j in self._unset & {*np.flatnonzero(known.any(axis=0)).tolist()}:
            self._unset.remove(j)
            item, late = self._model.inputs[j], (inputs.t[known[:, j]].min() - self._first) * 1e-9
            if late > MAX_UNSET_S:
                used = f"{item.default:g}{spaced(item.unit)} was used in its place"
                self._report(UNSET, f"{item.name} has no value in the first {late:.4g} s: {used}")

    def _paused(self, passed: Passed) -> Passed:
        """Return the events with queries in each gap, and a restart of the driven states at the end of each pause."""
        unknown = self._unknown
        t = passed.events.t[np.isin(passed.events.kind, (READING, INPUT))]
        newest = np.maximum.accumulate(np.concatenate(([self._newest], t)))
        self._newest = int(newest[-1])
        known = newest[:-1] != BEFORE
        periods = np.where(known, newest[1:] - newest[:-1], 0)
        regular = np.flatnonzero(periods > 0)
        before = [*self._periods, *periods[regular].tolist()]
        places = len(self._periods) + np.searchsorted(regular, np.arange(t.size))
        self._periods.extend(before[-PERIODS:])
        after = [] if self._gap is None else [self._gap]
        after += [] if unknown is None else [unknown.after]
        for k in np.flatnonzero(periods > min(after)).tolist():
            recent = before[max(0, places[k] - PERIODS) : places[k]]
            usual = float(np.median(recent)) if recent else 0.0
            if self._gap is not None and periods[k] > max(self._gap, GAP_PERIODS * (usual or np.inf)):
                shares = np.linspace(0.0, 1.0, GAP_QUERIES + 1)[1:] ** 2  # denser where the variance grows fastest
                times = newest[k] + (shares * (periods[k] - 1)).astype(np.int64)
                passed = self._with(passed, blank(times, TICK, 0, self._model.width))
            if unknown is None or periods[k] <= max(unknown.after, PAUSE_PERIODS * usual):
                continue
            length = periods[k] * 1e-9
            self._report(
                PAUSED,
                f"no event for {length:.4g} s until {t[k] * 1e-9:.6g} s, longer than time.paused_after: its inputs are "
                f"unknown, {_restarted(unknown.states, self._model)}",
            )
            # Before all events that end the pause.
            passed = self._restart(passed, int(t[k]) - 1, unknown.states)
        return passed

    def _restart(self, passed: Passed, t: int, states: Sequence[int]) -> Passed:
        """Return the events with some whose states restart at t (ns)."""
        return self._with(passed, maintained(t, t, states, self._model.width))

    def _with(self, passed: Passed, events: Events) -> Passed:
        """Return the events with others, to which no horizon applies."""
        settled = np.concatenate((passed.settled, np.ones(len(events), np.bool_)))
        return passed._replace(events=Events.concat([passed.events, events], self._model.width), settled=settled)

    def _named(self, kind: int, channel: int) -> str:
        if kind == READING:
            return self._model.sensors[channel].name
        return "the inputs" if kind == INPUT else "the true states"


def dropped_episode(start: float, lost: int, taken: int) -> Episode:
    """Return the episode of so many lost measurements of all that were taken since `start`, s."""
    text = detector_of("dropped").text(SimpleNamespace(percent=100 * lost / taken, counts=f"{lost} of {taken}"))
    return Episode(start, None, "twin", "dropped", lost / taken, math.nan, math.nan, "", text)


def refusal(name: str, refused: Refused) -> str:
    """Return the line for a rejected event of a channel."""
    ahead = (refused.t - refused.expected) * 1e-9
    return (
        f"{name}: its time, {refused.t * 1e-9:.9g} s, is {ahead:.6g} s after the newest, and the next events do not "
        "confirm it; rejected"
    )


def clock_lines(every: Sequence[Moved], name: Callable[[Moved], str]) -> Iterator[str]:
    """Yield a line for the channels whose clocks made the same step, as all of one source share its clock."""
    for step in dict.fromkeys(item.by for item in every):
        moved = [item for item in every if item.by == step]
        by, begun, names = step * 1e-9, min(item.t for item in moved) * 1e-9, [*map(name, moved)]
        named = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
        whose, where = "its" if len(names) == 1 else "their", "ahead" if by > 0 else "back"
        yield (
            f"{named}: {whose} clock was set {abs(by):.6g} s {where} at {begun:.9g} s; times from there on are "
            "corrected by it (if the rows are out of order, sort them by time)"
        )
