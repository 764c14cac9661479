"""Row counts for the status."""

from __future__ import annotations

import numpy as np

from estimators.model.state_space import StateSpaceModel
from estimators.plausibility import reasons_by_sensor
from estimators.track import FAILED, GATED, MISSING, REASONS, SCREENED, VERDICT_NAMES, Track

MAX_UNSETTLED_ROWS = 8192
"""Last rows, which are counted each time; a late measurement rarely reaches back further."""


class RowCounts:
    """Rows of each sensor by verdict and by reason of the plausibility checks, since the start.

    Settled rows are counted once.
    """

    def __init__(self, model: StateSpaceModel) -> None:
        self._sensors = model.sensor_names
        self.by_sensor = np.zeros((len(self._sensors), len(VERDICT_NAMES)), np.int64)
        """Rows by sensor and verdict, as last counted."""
        self._forgotten = np.zeros((len(self._sensors), len(VERDICT_NAMES) + len(REASONS)), np.int64)
        self.again()

    def again(self) -> None:
        """Count all rows again, on top of the dropped ones."""
        self._settled, self._counts = 0, self._forgotten.copy()

    def changed(self, index: int) -> None:
        """Note that the rows from `index` on changed."""
        if index < self._settled:
            self.again()

    def forget(self, track: Track, channel: np.ndarray) -> None:
        """Drop the oldest rows, with these channels."""
        self._forgotten = self._forgotten + self._of(track, channel, slice(0, len(track)))
        self.again()

    def count(self, track: Track, channel: np.ndarray) -> dict[str, int]:
        """Return counts in total, by verdict, and by sensor and reason, given all rows and their channels."""
        settled = max(self._settled, len(track) - MAX_UNSETTLED_ROWS)
        self._counts += self._of(track, channel, slice(self._settled, settled))
        self._settled = settled
        table = self._counts + self._of(track, channel, slice(settled, len(track)))
        each, reasons = np.split(table, [len(VERDICT_NAMES)], axis=1)
        self.by_sensor = each
        totals = each.sum(axis=0)
        counts = {"readings": int(totals[1:].sum())}
        counts |= {name: int(count) for name, count in zip(VERDICT_NAMES[1:], totals[1:], strict=True)}
        if len(self._sensors) > 1:
            for code in (GATED, MISSING, FAILED, SCREENED):
                for sensor in np.flatnonzero(each[:, code]):
                    counts[f"{VERDICT_NAMES[code]} {self._sensors[sensor]}"] = int(each[sensor, code])
        for sensor, reason in np.argwhere(reasons):
            counts[f"{REASONS[reason]} {self._sensors[sensor]}"] = int(reasons[sensor, reason])
        return counts

    def _of(self, track: Track, channel: np.ndarray, rows: slice) -> np.ndarray:
        """Return the rows with each verdict, then each reason (columns), by sensor; verdict 0 is no measurement."""
        verdict, channel = track.verdict[rows], channel[rows]
        sensors, kinds = len(self._sensors), len(VERDICT_NAMES)
        flat = np.where(verdict == 0, 0, channel * kinds + verdict)
        each = np.bincount(flat, minlength=sensors * kinds).reshape(-1, kinds)
        return np.hstack((each, reasons_by_sensor(sensors, channel, track.screened[rows])))


def last_run(codes: np.ndarray) -> int:
    """Return the index of the first of the equal codes at the end of an array that is not empty."""
    end = len(codes)
    while end > 0:
        start = max(0, end - MAX_UNSETTLED_ROWS)
        others = np.flatnonzero(codes[start:end] != codes[-1])
        if others.size:
            return start + int(others[-1]) + 1
        end = start
    return 0
