"""Report unusable measurements and lost estimates of the running twin as its rows arrive; see also episode_log.py."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from estimators.diagnostics.failure_cause import failures
from estimators.fold import Fold
from estimators.fold_failures import cause_of
from estimators.gate.isolation import AGREES
from estimators.log import Log
from estimators.model.parts import Limits
from estimators.model.state_space import StateSpaceModel
from estimators.track import FAILED, GATED, MISSING, REASONS, VERDICT_NAMES, Track, estimated_rows

from .counts import last_run
from .notices import Notices

MAX_CAUSE_SEARCHES = 3
"""Failures of one fold whose cause is sought; a reading of 1e300 has none in the model, so more than one."""


class Alerts:
    """Report unusable measurements and lost estimates of a fold."""

    def __init__(self, notices: Notices, in_alarm: Callable[[], frozenset[str]] = frozenset) -> None:
        """`in_alarm`: returns the sensors with an open episode, whose rejected measurements need no report."""
        self._notices, self._in_alarm = notices, in_alarm
        self._said: set[str] = set()
        self.again()
        self._examine_all = False

    @property
    def lost(self) -> int | None:
        """Time (ns) from which the estimate has not been finite; None while it is."""
        return None if self._lost is None else self._lost[1]

    def again(self) -> None:
        """Reset the counts for another fold, none of whose rows has been examined."""
        self._recoveries = self._failures = self._searches = 0
        self._decided = -np.inf
        self._lost: tuple[int, int] | None = None
        self._said.clear()
        self._examine_all = True

    def examined(self, fold: Fold) -> None:
        """Note that the rows so far were reported by an earlier process."""
        self._failures, self._recoveries = fold.failures, fold.recoveries()
        self._decided = max([self._decided, *(decision.time for decision in fold.decisions)])
        self._lost, self._examine_all = self._first_lost_row(fold, 0), False

    def report(self, fold: Fold, before: int) -> None:
        """Report the rows from `before` on."""
        say, report = self._notices.say, self._notices.report
        known = {f"gated {name}" for name in self._in_alarm()}
        for key, text, t in rejections(fold.model, fold.log, fold.track, before):
            if key not in known:
                report(key, text, counted=False, t=t)
        failed, self._failures = fold.failures > self._failures, fold.failures
        text = str(fold.failure)
        if failed and text not in self._said:
            self._said.add(text)
            more = "the readings concerned count as failed, and the estimate goes on where the model answers again"
            report("model failed", f"{text}; {more}", level="error", counted=False)
        self._search_cause(fold, before)
        # A late measurement repeats decisions; each is reported once.
        for decision in [decision for decision in fold.decisions if decision.time > self._decided]:
            level = "info" if decision.outcome == AGREES else "warn"
            report(f"{decision.outcome} {decision.sensor}", decision.text, level=level, t=round(1e9 * decision.time))
            self._decided = decision.time
        recoveries, self._recoveries = self._recoveries, fold.recoveries()
        if self._recoveries > recoveries:
            text = "no particle explained a reading; the cloud was widened"
            report("recovered", f"{fold.estimator.name}: {text}, {self._recoveries} time(s) so far", counted=False)
        was_lost, self._lost = self._lost is not None, self._first_lost_row(fold, before)
        if self._lost is not None and not was_lost:
            text = "the estimate is not a number; Reset, or another filter, may help"
            say(text, level="error", t=self._lost[1])

    def _first_lost_row(self, fold: Fold, before: int) -> tuple[int, int] | None:
        """Return index and time of the first of the last rows without a finite estimate; None if there is none."""
        track, log, known = fold.track, fold.log, self._lost
        if not fold.n:
            return None
        fresh = estimated_rows(track, min(before, fold.n - 1))
        if fresh[-1]:
            return None
        if known is not None and known[0] < log.first + before and not fresh.any():
            return known
        index = last_run(estimated_rows(track))
        return log.first + index, int(log.t[index])

    def _search_cause(self, fold: Fold, before: int) -> None:
        """Report, once per fold, the model function that made a measurement or the estimate fail."""
        first, self._examine_all = 0 if self._examine_all else before, False
        if self._searches >= MAX_CAUSE_SEARCHES or fold.failure is not None:
            return
        rows = failures(fold.track, first)
        if rows.size:
            self._searches += 1
            text = cause_of(fold, int(rows[0]))
            if text is not None:
                self._searches = MAX_CAUSE_SEARCHES
                self._notices.say(text, level="error", t=int(fold.log.t[rows[0]]))


def rejections(model: StateSpaceModel, log: Log, track: Track, first: int) -> Iterator[tuple[str, str, int]]:
    """Yield key, text and time (ns) of the last measurement that was not used, from row `first` on.

    One of each verdict, and of those that the plausibility checks rejected one of each sensor and reason.
    """
    for code, what in ((GATED, "rejected by the gate"), (MISSING, "has no value"), (FAILED, "could not be used")):
        rows = np.flatnonzero(track.verdict[first:] == code)
        if rows.size:
            row = first + int(rows[-1])
            sensor = model.sensors[log.channel[row]].name
            nis = f" (NIS {track.nis[row]:.3g})" if np.isfinite(track.nis[row]) else ""
            yield f"{VERDICT_NAMES[code]} {sensor}", f"{sensor}: measurement {what}{nis}", int(log.t[row])
    last = {
        (int(log.channel[first + i]), reason): (first + i, k)
        for i, k in np.argwhere(track.screened[first:]).tolist()
        for reason in range(len(REASONS))
        if int(track.screened[first + i, k]) & (1 << reason)
    }
    for (sensor, reason), (i, k) in last.items():
        text = _implausible(model, sensor, k, REASONS[reason], float(log.value[i, k]))
        yield f"{REASONS[reason]} {model.sensors[sensor].name}", text, int(log.t[i])


def _implausible(model: StateSpaceModel, sensor: int, k: int, reason: str, value: float) -> str:
    limits, unit = model.sensors[sensor].limits or Limits(), model.sensors[sensor].rows[k].unit
    what = f"{model.row_names[model.row_start[sensor] + k]}: {value:.6g} {unit}"
    if reason in ("range", "saturated"):
        pairs = limits.range if reason == "range" else limits.saturation
        low, high = pairs[k % len(pairs)]
        ends = f"{low:g} to {high:g} {unit}"
        if reason == "range":
            return f"{what} is outside {ends}; not used: look at the sensor, or widen its range"
        return f"{what} is where its converter clips, {ends}; not used: the quantity may lie anywhere beyond"
    if reason == "rate":
        most = f"{limits.rate[k % len(limits.rate)]:g} {unit}/s"
        return f"{what} is further from the last good reading than {most} allows; not used until it comes back"
    if reason == "stuck":
        return f"{what} has been repeated for too long; not used until it changes: look at the sensor"
    return f"{what} came again; it counts once: look for what repeats readings on their way"
