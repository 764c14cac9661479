"""Check the order of a table's times, and report wrong sorting, a wrong unit or a wrong column once."""

from __future__ import annotations

import numpy as np

from estimators.errors import SourceError
from estimators.log import BEFORE

from ..source import WRONG_TIME, Report

MAX_EQUAL_TIMES = 100_000  # Consecutive rows of equal time from which on the time column is reported
BACKWARDS, STANDING = REMARKS = ("times run backwards", "time stands still")  # Keys under which it is reported

MIN_ORDERED_TIMES = 3
"""Ordered times that must follow before a first time is reported as wrong, or rows as reversed."""


class Order:
    """Checks the times of the rows as they are read.

    A row that is older than one before it by more than the horizon is dropped as stale by the log, unless the guard of
    times finds a lone wrong time or a clock that was set (estimators/events/clocks.py); the first of them is reported
    with its line. Late rows within the horizon are as recorded, and put where they belong.
    """

    def __init__(self, column: str, unit: str, horizon: int | None, report: Report) -> None:
        """Look at the times of `column`, in `unit`; `horizon` in ns, None for none."""
        self._column, self._unit, self._horizon, self._report = column, unit, horizon, report
        self._newest, self._newest_at = BEFORE, ""
        self._run, self._run_at, self._run_length = BEFORE, "", 0
        self._reported: set[str] = set()

    def first(self, file: str, line: np.ndarray, t: np.ndarray) -> int:
        """Return how many of a file's first rows to leave out: those of one time, ahead of all that follow.

        Args:
            file: Its name.
            line: Lines of its first rows (n,).
            t: Their times (n,), ns.

        Raises:
            SourceError: If the newest row comes first and the oldest last: nearly all would be too late.
        """
        if self._horizon is None or not t.size:
            return 0
        change = np.flatnonzero(np.diff(t)) + 1
        if change.size < MIN_ORDERED_TIMES:
            return 0
        if np.all(np.diff(t) <= 0) and t[0] - t[-1] > self._horizon:
            back = (t[0] - t[change[0]]) * 1e-9
            raise SourceError(
                f"{file}:{line[change[0]]}: {self._column} is {back:.6g} s before that of the row above, and so it "
                f"goes on; a recording must begin with its oldest row: sort the rows by {self._column}"
            )
        begin = int(change[0])
        rest = t[begin:]
        alone = t[0] - self._horizon > rest.max() and np.all(np.diff(t[change[:MIN_ORDERED_TIMES]]) > 0)
        if alone:
            after = (t[0] - t[begin]) * 1e-9
            self._report(
                WRONG_TIME,
                f"{file}:{line[0]}: {self._column} is {after:.6g} s after that of {file}:{line[begin]} and of all that "
                f"follow; the row is left out: correct its {self._column}, or sort the rows by it",
            )
        return begin if alone else 0

    def look(self, file: str, line: np.ndarray, t: np.ndarray) -> None:
        """Check the next rows: their lines and times (ns), each (n,)."""
        if t.size:
            self._backwards(file, line, t)
            self._standing(file, line, t)

    def _report_once(self, key: str, text: str) -> None:
        if key not in self._reported:
            self._reported.add(key)
            self._report(key, text)

    def _backwards(self, file: str, line: np.ndarray, t: np.ndarray) -> None:
        if self._horizon is None:
            return
        newest = np.maximum.accumulate(np.concatenate(([self._newest], t)))
        late = np.flatnonzero(t < newest[:-1] - self._horizon)
        if late.size:
            k = int(late[0])
            at = f"{file}:{line[int(np.argmax(t[:k]))]}" if k and np.max(t[:k]) > self._newest else self._newest_at
            self._report_once(
                BACKWARDS,
                f"{file}:{line[k]}: {self._column} is {(newest[k] - t[k]) * 1e-9:.6g} s before that of {at}, more than "
                f"time.horizon ({self._horizon * 1e-9:g} s), and such rows are dropped as stale, unless that was a "
                f"lone wrong time or a clock that was set; sort the rows by {self._column}, or raise time.horizon",
            )
        if newest[-1] > self._newest:
            self._newest, self._newest_at = int(newest[-1]), f"{file}:{line[int(np.argmax(t))]}"

    def _standing(self, file: str, line: np.ndarray, t: np.ndarray) -> None:
        edges = np.concatenate(([0], np.flatnonzero(np.diff(t)) + 1, [t.size]))
        lengths = np.diff(edges)
        carried = self._run_length if t[0] == self._run else 0
        lengths[0] += carried
        if not carried:
            self._run_at = f"{file}:{line[0]}"
        for k in np.flatnonzero(lengths >= MAX_EQUAL_TIMES):
            at = self._run_at if k == 0 else f"{file}:{line[edges[k]]}"
            self._report_once(
                STANDING,
                f"{at}: {self._column} stays {t[edges[k]] * 1e-9:g} s for {MAX_EQUAL_TIMES} rows and more; check that "
                f"it is the column of the time (time.column), and its unit (time.unit, {self._unit})",
            )
        if lengths.size > 1:
            self._run_at = f"{file}:{line[edges[-2]]}"
        self._run, self._run_length = int(t[-1]), int(lengths[-1])
