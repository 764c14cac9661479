"""Levels of detail: the extremes of rows in groups of 16, 64, 256, ...

A group is a range of absolute row indices. So a chart does not shimmer while its window slides, a peak of one row stays
visible at any scale, and only the newest groups change when rows arrive.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

FIRST = 16
"""Rows in a group of the finest level; finer groups are made from the rows."""

FACTOR = 4
"""Groups of one level in a group of the next."""

NEVER = 2**62
"""A row after every row."""


class Groups(NamedTuple):
    """Consecutive groups of `size` rows; the first has number `start`.

    first, last (k,): times of their first and last rows, ns. low, high (k, columns): their extremes, NaN of none.
    rising (k, columns): whether the last row of a group is not below its first.
    """

    size: int
    start: int
    first: np.ndarray
    last: np.ndarray
    low: np.ndarray
    high: np.ndarray
    rising: np.ndarray

    @property
    def n(self) -> int:
        """Number of groups."""
        return int(self.first.size)

    def part(self, start: int, stop: int) -> Groups:
        """Return those with numbers from `start` to before `stop`, as far as they exist."""
        start = max(start, self.start)
        rows = slice(start - self.start, max(start, stop) - self.start)
        return Groups(self.size, start, *(column[rows] for column in self[2:]))


def grouped(size: int, first: int, t: np.ndarray, values: np.ndarray) -> Groups:
    """Return rows, times (n,) ascending and values (n, columns), in groups of `size`; the first has index `first`."""
    if not t.size:
        return Groups(size, 0, t, t, values, values, values > 0.0)
    start, starts, lasts = _ends(size, first, t.size)
    low, high = _extremes(np.fmin, size, first, values), _extremes(np.fmax, size, first, values)
    return Groups(size, start, t[starts], t[lasts], low, high, values[lasts] >= values[starts])


def coarser(groups: Groups) -> Groups:
    """Return groups of `FACTOR` of these."""
    start, starts, lasts = _ends(FACTOR, groups.start, groups.n)
    low = _extremes(np.fmin, FACTOR, groups.start, groups.low)
    high = _extremes(np.fmax, FACTOR, groups.start, groups.high)
    middle = groups.low + groups.high
    # Where several become one, it rises if their middles do.
    rising = np.where((lasts > starts)[:, None], middle[lasts] >= middle[starts], groups.rising[starts])
    return Groups(groups.size * FACTOR, start, groups.first[starts], groups.last[lasts], low, high, rising)


def _ends(size: int, first: int, n: int) -> tuple[int, np.ndarray, np.ndarray]:
    """Return the number of the first group of n rows, and the first and last row of each, counted from `first`."""
    start = first // size
    ends = np.arange(start + 1, (first + n - 1) // size + 1) * size - first
    return start, np.concatenate(([0], ends)), np.concatenate((ends, [n])) - 1


def _extremes(extreme: np.ufunc, size: int, first: int, values: np.ndarray) -> np.ndarray:
    """Return the extremes (k, columns) of the rows of each group.

    Along rows this short, `reduceat` takes six times as long as pairs of neighbours, pairs of pairs and so on.
    """
    before, n = first % size, len(values)
    after = -(before + n) % size
    found = np.full((values.shape[1], before + n + after), np.nan)
    found[:, before : before + n] = values.T
    while size % 2 == 0:
        found, size = extreme(found[:, ::2], found[:, 1::2]), size // 2
    if size > 1:
        found = extreme.reduce(found.reshape(len(found), -1, size), axis=2)
    return found.T


class Pyramid:
    """The levels of some columns: the finest is kept up to date from the rows that changed, others when asked for."""

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._levels = {FIRST: _Level(FIRST, columns)}

    def update(self, first: int, t: np.ndarray, values: np.ndarray) -> None:
        """Take rows that are new or rewritten; they replace all known ones from there on.

        `first` is the absolute index of the first one: a multiple of `FIRST`, or the oldest row that still exists.
        Times (n,) ascend; values are (n, columns).
        """
        self._levels[FIRST].replace_from(grouped(FIRST, first, t, values))
        for level in self._levels.values():
            level.changed = min(level.changed, first)

    def forget(self, oldest: int) -> None:
        """Drop the groups whose rows are all older than that index."""
        for level in self._levels.values():
            level.drop(oldest // level.size)

    def level(self, size: int) -> Groups:
        """Return the groups of that size: `FIRST` times a power of `FACTOR`."""
        if size not in self._levels:
            self._levels[size] = _Level(size, self._columns)
        level = self._levels[size]
        if size > FIRST:
            finer = self.level(size // FACTOR)
            finer = finer.part(level.changed // size * FACTOR, finer.start + finer.n)
            if finer.n:
                level.replace_from(coarser(finer))
            level.changed = NEVER
        return level.groups


class _Level:
    """The groups of one size, in columns that grow by doubling."""

    def __init__(self, size: int, columns: int) -> None:
        self._start, self._n, self.size = 0, 0, size
        self.changed = 0
        """First row that is new since these groups were made of finer ones."""
        self._room: list[np.ndarray] = [
            np.zeros(64, np.int64), np.zeros(64, np.int64), np.zeros((64, columns)), np.zeros((64, columns)),
            np.zeros((64, columns), bool),
        ]  # fmt: skip

    @property
    def groups(self) -> Groups:
        """Return views of the groups."""
        first, last, low, high, rising = (column[: self._n] for column in self._room)
        return Groups(self.size, self._start, first, last, low, high, rising)

    def replace_from(self, fresh: Groups) -> None:
        """Put groups in place of those from their number on."""
        at = fresh.start - self._start
        if not 0 <= at <= self._n:
            self._start, at = fresh.start, 0
        needed = at + fresh.n
        if needed > len(self._room[0]):
            self._room = [np.resize(column, (2 * needed, *column.shape[1:])) for column in self._room]
        for column, new in zip(self._room, fresh[2:], strict=True):
            column[at:needed] = new
        self._n = needed

    def drop(self, number: int) -> None:
        """Drop the groups before a number, once they are half of all."""
        gone = min(number - self._start, self._n)
        if gone * 2 > self._n > 0:
            for column in self._room:
                column[: self._n - gone] = column[gone : self._n].copy()
            self._start, self._n = self._start + gone, self._n - gone
