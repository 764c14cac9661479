"""Many rows drawn as few points, without losing a peak.

Time is cut into buckets that are as wide as a pixel or two. Of each bucket only its extremes are drawn, so a spike of
one row stays visible; the buckets stand at fixed times, so the drawn line does not shimmer while the window slides;
and only the newest buckets are computed again, so a redraw costs what has arrived, not what is shown.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

CHUNK = 16_384
"""Rows that are worked on at once, so that a rebuild of a long history needs little memory."""


def extremes(values: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest of each group of rows, ignoring NaN.

    Args:
        values: Shape (rows, columns).
        starts: First row of each group, ascending; a group ends where the next begins.
    """
    return np.fmin.reduceat(values, starts, axis=0), np.fmax.reduceat(values, starts, axis=0)


class Buckets:
    """Extremes of some columns in buckets of `width` nanoseconds."""

    def __init__(self, columns: int, width: int) -> None:
        self.width = width
        self.first = np.zeros(0, np.int64)
        """Time of the first row of each bucket, and of the last."""
        self.last = np.zeros(0, np.int64)
        self.low = np.zeros((0, columns))
        self.high = np.zeros((0, columns))
        self.rising = np.zeros((0, columns), bool)

    def update(self, t: np.ndarray, changed: int, values: Callable[[int, int], np.ndarray]) -> None:
        """Bring the buckets up to date with rows of which those from `changed` on are new.

        Args:
            t: Times of the rows that are still here, shape (rows,), ascending; older ones are in the buckets only.
            changed: First row that is new or rewritten.
            values: values(start, end) gives the columns of some rows, shape (end - start, columns).
        """
        if not t.size:
            return
        kept = self.first // self.width
        bucket = int(t[min(changed, t.size - 1)]) // self.width
        at = int(np.searchsorted(kept, bucket))
        # Of a bucket whose first rows are gone, what it knew of them.
        known = (self.first[at], self.low[at], self.high[at]) if at < kept.size and self.first[at] < t[0] else None
        self._keep(slice(0, at))
        row = int(np.searchsorted(t, bucket * self.width))
        parts = [(self.first, self.last, self.low, self.high, self.rising)]
        ids = t[row:] // self.width
        starts = np.flatnonzero(np.diff(ids, prepend=ids[0] - 1)) + row
        ends = np.append(starts[1:], t.size)
        group = 0
        while group < starts.size:
            stop = max(group + 1, int(np.searchsorted(ends, starts[group] + CHUNK, side="right")))
            begin, end = int(starts[group]), int(ends[stop - 1])
            block = values(begin, end)
            low, high = extremes(block, starts[group:stop] - begin)
            rising = block[ends[group:stop] - 1 - begin] >= block[starts[group:stop] - begin]
            parts.append((t[starts[group:stop]], t[ends[group:stop] - 1], low, high, rising))
            group = stop
        self.first, self.last, self.low, self.high, self.rising = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )
        if known is not None:
            self.first[at] = known[0]
            self.low[at], self.high[at] = np.fmin(self.low[at], known[1]), np.fmax(self.high[at], known[2])

    def forget(self, before: int) -> None:
        """Drop the buckets that end before a time."""
        self._keep(slice(int(np.searchsorted(self.last, before)), None))

    def coarsen(self) -> None:
        """Make the buckets twice as wide, without the rows that they came from."""
        self.width *= 2
        if not self.first.size:
            return
        starts = np.flatnonzero(np.diff(self.first // self.width, prepend=-1))
        ends = np.append(starts[1:], self.first.size) - 1
        middle = self.low + self.high
        # Where two become one, it rises if their middles do.
        rising = np.where((ends > starts)[:, None], middle[ends] >= middle[starts], self.rising[starts])
        low, high = np.fmin.reduceat(self.low, starts, axis=0), np.fmax.reduceat(self.high, starts, axis=0)
        self.first, self.last, self.low, self.high, self.rising = self.first[starts], self.last[ends], low, high, rising

    def _keep(self, part: slice) -> None:
        self.first, self.last = self.first[part], self.last[part]
        self.low, self.high, self.rising = self.low[part], self.high[part], self.rising[part]

    def points(self, since: int) -> tuple[np.ndarray, np.ndarray]:
        """What to draw of the buckets that end at or after `since`: times (k,) and values (k, columns).

        A bucket of several times gives two points, its extremes in the order in which they lead on to the next; one of
        a single time gives the second of them only, which its last row tends to.
        """
        start = int(np.searchsorted(self.last, since))
        first, last = self.first[start:], self.last[start:]
        low, high, rising = self.low[start:], self.high[start:], self.rising[start:]
        wide = last > first
        times = np.stack((first, last), axis=1)
        upwards = rising == wide[:, None]
        values = np.stack((np.where(upwards, low, high), np.where(rising, high, low)), axis=1)
        # One extreme, as of a single reading among many rows: one point, not two side by side.
        same = low == high
        values[:, 1][same & ~rising] = np.nan
        mask = np.stack((np.ones_like(wide), wide), axis=1)
        return times[mask], values[mask]


def bridge(values: np.ndarray) -> np.ndarray:
    """Fill NaN between finite points on the straight line through them; outside, NaN stays."""
    good = np.flatnonzero(np.isfinite(values))
    if good.size < 2:
        return values
    index = np.arange(values.size)
    return np.interp(index, good, values[good], left=np.nan, right=np.nan)


def extended(values: np.ndarray) -> np.ndarray:
    """Fill all NaN: on straight lines between finite values, level before the first and after the last."""
    good = np.flatnonzero(np.isfinite(values))
    return np.interp(np.arange(values.size), good, values[good]) if good.size else values


def runs(values: np.ndarray, known: np.ndarray, most: int) -> list[np.ndarray]:
    """One column for each run of values that are known, with NaN elsewhere; at least one, at most `most`.

    Of more runs the oldest are in one column.
    """
    starts = known & ~np.append(False, known[:-1])
    number = np.cumsum(starts)
    count = int(number[-1]) if number.size else 0
    column = np.maximum(number - max(0, count - most), 1)
    return [np.where(known & (column == k), values, np.nan) for k in range(1, max(1, min(count, most)) + 1)]
