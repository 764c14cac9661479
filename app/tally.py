"""Counts for the status line: verdicts, and how long a reading took from its arrival to its row."""

from __future__ import annotations

import time

import numpy as np

from estimators.log import READING, Readings
from estimators.track import VERDICT_NAMES

UNSETTLED = 8192
"""Rows at the end that the tally counts each time; a late reading rarely reaches behind them."""

LATENCIES = 4096


class Tally:
    """Rows by verdict since the start; those that are settled are counted once."""

    def __init__(self) -> None:
        self._forgotten = np.zeros(len(VERDICT_NAMES), np.int64)
        self.again()

    def again(self) -> None:
        """Rows moved or changed: count them anew, on top of what the forgotten ones held."""
        self._settled, self._counts = 0, self._forgotten.copy()

    def changed(self, index: int) -> None:
        """Rows from `index` on changed."""
        if index < self._settled:
            self.again()

    def forget(self, verdicts: np.ndarray) -> None:
        """The oldest rows, with these verdicts, are dropped."""
        self._forgotten = self._forgotten + np.bincount(verdicts, minlength=len(VERDICT_NAMES))
        self.again()

    def count(self, verdict: np.ndarray) -> dict[str, int]:
        """Readings in all and by verdict, given the verdicts of all rows."""
        settled = max(self._settled, len(verdict) - UNSETTLED)
        self._counts += np.bincount(verdict[self._settled : settled], minlength=len(VERDICT_NAMES))
        self._settled = settled
        totals = self._counts + np.bincount(verdict[settled:], minlength=len(VERDICT_NAMES))
        names = zip(VERDICT_NAMES[1:], totals[1:], strict=True)
        return {"readings": int(totals[1:].sum()), **{name: int(count) for name, count in names}}


class Latency:
    """The last times from arrival to row."""

    def __init__(self) -> None:
        self._ms = np.zeros(LATENCIES)
        self._n = 0

    def note(self, batch: Readings) -> None:
        """The rows of a batch are there."""
        arrivals = batch.arrival[batch.kind == READING]
        if not arrivals.size:
            return
        took = (time.time_ns() - arrivals[-LATENCIES:]) * 1e-6
        at = (self._n + np.arange(took.size)) % LATENCIES
        self._ms[at] = took
        self._n += took.size

    def percentile(self, percent: float) -> float | None:
        """Milliseconds that so many percent did not exceed."""
        count = min(self._n, LATENCIES)
        return float(np.percentile(self._ms[:count], percent)) if count else None
