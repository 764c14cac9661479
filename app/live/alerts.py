"""Report unusable measurements, lost estimates and silent sources of the running twin; see also episode_log.py."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from estimators.diagnostics.failure_cause import failures
from estimators.fold import Fold
from estimators.fold_failures import cause_of
from estimators.gate.isolation import AGREES
from estimators.track import STALE, WAITING, estimated_rows

from .counts import UNSETTLED, complaints, refusals
from .notices import Notices

MAX_CAUSE_SEARCHES = 3
"""Failures of one fold whose cause is sought; a reading of 1e300 has none in the model, so more than one."""


class Alerts:
    """Report unusable measurements and lost estimates of a fold as its rows arrive."""

    def __init__(self, notices: Notices, in_alarm: Callable[[], frozenset[str]] = frozenset) -> None:
        """`in_alarm`: returns the sensors with an open episode."""
        self._notices, self._in_alarm = notices, in_alarm
        self._recoveries = 0
        self._lost: tuple[int, int] | None = None
        self._failures = 0
        self._decided = -np.inf
        self._said: set[str] = set()
        self._tries, self._fresh = 0, False

    @property
    def lost(self) -> int | None:
        """Time (ns) from which the estimate has not been finite; None while it is."""
        return None if self._lost is None else self._lost[1]

    def again(self) -> None:
        """Reset the counts for another fold."""
        self._recoveries = self._failures = 0
        self._decided = -np.inf
        self._lost = None
        self._said.clear()
        # None of its rows has been examined.
        self._tries, self._fresh = 0, True

    def look(self, fold: Fold, before: int) -> None:
        """Report the rows from `before` on."""
        track, log = fold.track, fold.log
        known = {f"gated {name}" for name in self._in_alarm()}
        for key, text in complaints(fold.model, log.channel, track, before):
            if key not in known:
                self._notices.report(key, text, counted=False)
        for key, text in refusals(fold.model, log, track, before):
            self._notices.report(key, text, counted=False)
        self._look_at_failures(fold)
        self._look_for_cause(fold, before)
        self._look_at_decisions(fold)
        count, told = fold.recoveries(), self._recoveries
        self._recoveries = count
        if count > told:
            name = fold.estimator.name
            text = f"{name}: no particle explained a reading; the cloud was widened, {count} time(s) so far"
            self._notices.report("recovered", text, counted=False)
        was_lost = self._lost is not None
        self._lost = self._look_for_numbers(fold, before)
        if self._lost is not None and not was_lost:
            text = "the estimate is not a number; Reset, or another filter, may help"
            self._notices.say(text, level="error", t=self._lost[1])

    def _look_for_numbers(self, fold: Fold, before: int) -> tuple[int, int] | None:
        """Return index and time of the first of the last rows without a finite estimate; None if there is none."""
        track, log = fold.track, fold.log
        end = len(track)
        if not end or estimated_rows(track.select(slice(end - 1, end)))[0]:
            return None
        known = self._lost
        if (
            known is not None
            and known[0] < log.first + before
            and not estimated_rows(track.select(slice(before, end))).any()
        ):
            return known
        while end > 0:
            start = max(0, end - UNSETTLED)
            good = np.flatnonzero(estimated_rows(track.select(slice(start, end))))
            if good.size:
                end = start + int(good[-1]) + 1
                break
            end = start
        return log.first + end, int(log.t[end])

    def _look_at_decisions(self, fold: Fold) -> None:
        """Report decisions about rejected sensors, each once, even if a late measurement repeats one."""
        new = [decision for decision in fold.decisions if decision.time > self._decided]
        for decision in new:
            level = "info" if decision.outcome == AGREES else "warn"
            self._notices.report(f"{decision.outcome} {decision.sensor}", decision.text, level=level)
            self._decided = decision.time

    def _look_at_failures(self, fold: Fold) -> None:
        """Report errors of a black-box model, each text once."""
        count, known = fold.failures, self._failures
        self._failures = count
        text = str(fold.failure)
        if count > known and text not in self._said:
            self._said.add(text)
            more = "the readings concerned count as failed, and the estimate goes on where the model answers again"
            self._notices.report("model failed", f"{text}; {more}", level="error", counted=False)

    def _look_for_cause(self, fold: Fold, before: int) -> None:
        """Report, once per fold, the model function that made a measurement or the estimate fail."""
        first = 0 if self._fresh else before
        self._fresh = False
        if self._tries >= MAX_CAUSE_SEARCHES or fold.failure is not None:
            return
        rows = failures(fold.track, first)
        if rows.size:
            self._tries += 1
            text = cause_of(fold, int(rows[0]))
            if text is not None:
                self._tries = MAX_CAUSE_SEARCHES
                self._notices.say(text, level="error", t=int(fold.log.t[rows[0]]))


class SilentSource:
    """Health of a twin whose source is open but has no events yet."""

    def __init__(self, notices: Notices, stale_after: float, clock: Callable[[], float] = time.monotonic) -> None:
        """`stale_after`: seconds without an event after which a live source is stale; `clock` returns seconds."""
        self._notices, self._after, self._clock = notices, stale_after, clock
        self._since = clock()
        self._told = False

    @property
    def health(self) -> int:
        """Waiting, or stale."""
        return STALE if self._told else WAITING

    @property
    def cause(self) -> str:
        """Reason why the twin is stale, or "" while it waits."""
        if not self._told:
            return ""
        return f"nothing has come since the twin started, {self._clock() - self._since:.0f} s ago; check the source"

    def look(self, *, live: bool) -> None:
        """Report a live source without events, once it is stale; a recording may be paused."""
        if live and not self._told and self._clock() - self._since > self._after:
            self._told = True
            text = f"stale: nothing has come since the twin started, {self._after:g} s ago; check the source"
            self._notices.say(text, level="warn")

    def broken(self) -> None:
        """Note that the first event has arrived."""
        if self._told:
            self._told = False
            silent = self._clock() - self._since
            self._notices.say(f"the source speaks, {silent:.0f} s after the twin started")
