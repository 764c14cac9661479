"""Check the order of a table's times: sort rows that are out of order, and report a wrong unit or column once."""

from __future__ import annotations

import numpy as np

from estimators.events.clocks import nearest_zone
from estimators.log import BEFORE, INPUT, Events

from ..source import WRONG_TIME, Report

MAX_EQUAL_TIMES = 100_000  # Consecutive rows of equal time from which on the time column is reported
BACKWARDS, SORTED, STANDING = REMARKS = ("times run backwards", "rows sorted", "time stands still")
"""Keys under which it is reported."""

MIN_ORDERED_TIMES = 3
"""Ordered times that must follow before a first time is reported as wrong; fewer, far from all others, are wrong."""

MAX_GAP_INTERVALS = 20.0  # Median intervals, beyond which times are far from each other


class Order:
    """Checks the times of the rows as they are read, and sorts what they gave once all are known.

    Late rows within the horizon are as recorded, and put where they belong. Rows that are older than one before them by
    more than the horizon would be dropped as stale by the log. A recording is finite, so they are sorted, unless they
    show a lone wrong time or a clock that was set, which the guard of times corrects (estimators/events/clocks.py). The
    first of them is reported with its line.
    """

    def __init__(self, column: str, unit: str, horizon: int | None, report: Report) -> None:
        """Look at the times of `column`, in `unit`; `horizon` in ns, None for none."""
        self._column, self._unit, self._horizon, self._report = column, unit, horizon, report
        self._newest, self._newest_at = BEFORE, ""
        self._late, self._late_rows = "", 0
        self._run, self._run_at, self._run_length = BEFORE, "", 0
        self._stands = False

    def first(self, file: str, line: np.ndarray, t: np.ndarray) -> int:
        """Return how many of a file's first rows to leave out: those of one time, ahead of all that follow.

        Args:
            file: Its name.
            line: Lines of its first rows (n,).
            t: Their times (n,), ns.
        """
        if self._horizon is None or not t.size:
            return 0
        change = np.flatnonzero(np.diff(t)) + 1
        if change.size < MIN_ORDERED_TIMES:
            return 0
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

    def check(self, file: str, line: np.ndarray, t: np.ndarray) -> None:
        """Check the next rows: their lines and times (ns), each (n,)."""
        if t.size:
            self._backwards(file, line, t)
            self._standing(file, line, t)

    def arranged(self, events: Events) -> Events:
        """Return all events of the recording in the order in which they enter the log, and report wrong sorting."""
        if not self._late or self._horizon is None:
            return events
        key = np.where(events.kind == INPUT, np.argmax(np.isfinite(events.value), axis=1), events.channel)
        order = time_order(events.t, 4 * key.astype(np.int64) + events.kind, self._horizon)
        self.report_late(order is not None)
        return events if order is None else events.select(order)

    def report_late(self, sorted_rows: bool) -> None:
        """Report the rows that are too late, each with the place of the first, and whether the rows were sorted."""
        if not self._late or self._horizon is None:
            return
        text = (
            f"{self._late}, more than time.max_delay ({self._horizon * 1e-9:g} s), which is a lone wrong time or a "
            f"change of time zone, so the rows are not sorted: correct {self._column}, or give its time.zone"
        )
        if sorted_rows:
            rule = f"the rows are out of order and were sorted by {self._column}"
            text = f"{self._late}; {rule}; if its clock was set there, correct it"
        for _ in range(self._late_rows):
            self._report(SORTED if sorted_rows else BACKWARDS, text)

    def _backwards(self, file: str, line: np.ndarray, t: np.ndarray) -> None:
        if self._horizon is None:
            return
        newest = np.maximum.accumulate(np.concatenate(([self._newest], t)))
        late = np.flatnonzero(t < newest[:-1] - self._horizon)
        self._late_rows += late.size
        if late.size and not self._late:
            k = int(late[0])
            at = f"{file}:{line[int(np.argmax(t[:k]))]}" if k and np.max(t[:k]) > self._newest else self._newest_at
            back = (newest[k] - t[k]) * 1e-9
            self._late = f"{file}:{line[k]}: {self._column} is {back:.6g} s before that of {at}"
        if newest[-1] > self._newest:
            self._newest, self._newest_at = int(newest[-1]), f"{file}:{line[int(np.argmax(t))]}"

    def _standing(self, file: str, line: np.ndarray, t: np.ndarray) -> None:
        edges = np.concatenate(([0], np.flatnonzero(np.diff(t)) + 1, [t.size]))
        lengths = np.diff(edges)
        carried = self._run_length if t[0] == self._run else 0
        lengths[0] += carried
        if not carried:
            self._run_at = f"{file}:{line[0]}"
        for k in np.flatnonzero(lengths >= MAX_EQUAL_TIMES)[: not self._stands]:
            self._stands = True
            at = self._run_at if k == 0 else f"{file}:{line[edges[k]]}"
            self._report(
                STANDING,
                f"{at}: {self._column} stays {t[edges[k]] * 1e-9:g} s for {MAX_EQUAL_TIMES} rows and more; check that "
                f"it is the column of the time (time.column), and its unit (time.unit, {self._unit})",
            )
        if lengths.size > 1:
            self._run_at = f"{file}:{line[edges[-2]]}"
        self._run, self._run_length = int(t[-1]), int(lengths[-1])


def time_order(t: np.ndarray, key: np.ndarray, horizon: int) -> np.ndarray | None:
    """Return the order in which to read the rows of a recording; None if they stay as recorded.

    Rows stay as recorded if none is late, if only lone wrong times are, or if a clock was set back by a change of time
    zone. A lone wrong time stays behind the row before it.

    Args:
        t: Times (n,), ns, in the order of the recording.
        key: Channel of each row (n,); rows of different channels may have the same times.
        horizon: Time by which a row may be late, ns.
    """
    if not np.any(t < np.maximum.accumulate(t) - horizon):
        return None
    place = np.arange(t.size)
    lone = np.zeros(t.size, np.bool_)
    for one in np.unique(key):
        rows = np.flatnonzero(key == one)
        wrong = _lone(t[rows], horizon)
        lone[rows[wrong]] = True
        rows = rows[~wrong]
        behind = t[rows] < np.maximum.accumulate(t[rows]) - horizon
        if _was_set(t[rows], behind, horizon):
            return None
    kept = t[~lone]
    if not np.any(kept < np.maximum.accumulate(kept) - horizon):
        return None
    before = np.maximum.accumulate(np.where(lone, -1, place))
    at = np.where(before < 0, BEFORE, t[before])
    return np.lexsort((place, at))


def _usual(ordered: np.ndarray) -> float:
    apart = np.diff(ordered)
    return float(np.median(apart[apart > 0])) if np.any(apart > 0) else 0.0


def _lone(t: np.ndarray, horizon: int) -> np.ndarray:
    """Return which times are out of order, and with fewer than `MIN_ORDERED_TIMES` far from all others."""
    order = np.argsort(t, kind="stable")
    far = np.diff(t[order]) > max(horizon, MAX_GAP_INTERVALS * _usual(t[order]))
    group = np.concatenate(([0], np.cumsum(far)))
    few = np.bincount(group)[group] < MIN_ORDERED_TIMES
    found = np.zeros(t.size, np.bool_)
    found[order] = few
    later = np.minimum.accumulate(t[::-1])[::-1]
    return found & ((t < np.maximum.accumulate(t) - horizon) | (t > later + horizon))


def _was_set(t: np.ndarray, behind: np.ndarray, horizon: int) -> bool:
    """Return whether most late times are in stretches that begin whole quarter hours earlier.

    That is a change of time zone or daylight saving time, unless the stretch ends where the times before it begin:
    these are files in the wrong order.
    """
    edges = np.flatnonzero(np.diff(np.concatenate(([False], behind, [False])).astype(np.int8)))
    usual = _usual(np.sort(t))
    moved = 0
    for begin, end in edges.reshape(-1, 2):
        stretch, before = t[begin:end], t[:begin]
        step = int(before[-1] + usual - stretch[0])
        zone = nearest_zone(step)
        after = np.min(before[before > stretch.max()], initial=np.iinfo(np.int64).max)
        apart = after - stretch.max() > horizon + MAX_GAP_INTERVALS * usual
        repeats = np.any((before >= stretch.min()) & (before <= stretch.max()))
        if stretch.size >= MIN_ORDERED_TIMES and zone > 0 and abs(zone - step) <= max(horizon, usual):
            moved += stretch.size * bool(repeats or apart)
    return bool(2 * moved > np.count_nonzero(behind))
