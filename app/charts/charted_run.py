"""Rows of one fold for charts, with levels of detail of the columns that charts show from afar."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol

import numpy as np

from estimators.log import READING
from estimators.numerics.linalg import wrapped
from estimators.track import estimated_rows

from ..columns import Column, Rows
from ..engine.copies import MAX_PULL_ROWS, Cursor, Pull
from ..engine.history_copy import follow
from ..engine.running_fold import Running
from .levels_of_detail import FIRST, Groups, Pyramid, grouped


class RowSource(Protocol):
    """Rows of a fold by absolute index: the engine, a pinned fold or kept rows; see `Running`."""

    def cursor(self) -> Cursor:
        """Return a cursor for `pull`."""

    def release(self, cursor: Cursor) -> None:
        """Give a cursor back."""

    def pull(self, cursor: Cursor, limit: int | None = None, *, align: int = 1) -> Pull:
        """Return the rows since the cursor, from a multiple of `align` on and at most `limit`."""

    def rows(self, start: int, stop: int) -> Pull:
        """Return the rows with these absolute indices, as far as they exist."""

    def index_at(self, t: int) -> int:
        """Return the absolute index of the first row at or after a time, ns."""


class KeptRows:
    """Rows that never change: of the previous run, of a pinned one, or smoothed."""

    def __init__(self, pull: Pull) -> None:
        self.of = pull

    def __eq__(self, other: object) -> bool:
        return isinstance(other, KeptRows) and other.of is self.of

    def cursor(self) -> Cursor:
        """See `RowSource`."""
        return Cursor()

    def release(self, cursor: Cursor) -> None:
        """See `RowSource`."""

    def pull(self, cursor: Cursor, limit: int | None = None, *, align: int = 1) -> Pull:
        """See `RowSource`; all rows at once, as they are not copied."""
        if cursor.log == 0:
            return self.rows(self._end, self._end)
        cursor.log, cursor.next = 0, self._end
        return replace(self.of, fresh=True, changed=self.of.first)

    def rows(self, start: int, stop: int) -> Pull:
        """See `RowSource`."""
        first = self.of.first
        part = slice(max(0, start - first), max(0, stop - first))
        return Pull(
            self.of.revision, False, first + part.start, self.of.events.select(part), self.of.track.select(part)
        )

    def index_at(self, t: int) -> int:
        """See `RowSource`."""
        return self.of.first + int(np.searchsorted(self.of.events.t, t))

    @property
    def _end(self) -> int:
        return self.of.first + len(self.of.events)


class ChartedRun:
    """Rows of a source as charts show them, or, with `minus`, their means less those of the running fold.

    Not thread-safe. `end` is the row after the last, `changed` the first row that changed in the last `sync` (`end` if
    none did). `generation` counts up when all rows change: another revision or log, or levels of other columns.
    """

    def __init__(self, source: RowSource, columns: dict[str, Column], minus: Running | None = None) -> None:
        self.source, self._columns, self._minus = source, columns, minus
        self._cursor = source.cursor()
        self._running = -1
        self.levelled: list[str] = []
        """Columns with levels of detail."""
        self._pyramid = Pyramid(0)
        self.revision = -1
        self.generation = self.changed = self.end = 0

    def close(self) -> None:
        """Give the cursor back."""
        self.source.release(self._cursor)

    def sync(self, columns: Iterable[str]) -> None:
        """Take new rows, and bring the levels of these columns up to date.

        Columns that need no levels any more cost nothing from the next revision on.
        """
        columns = set(columns)
        running = -1 if self._minus is None else self._minus.revisions.runs[-1].number
        if not columns.issubset(self.levelled) or running != self._running:
            self._running = running
            self.close()
            self._cursor = self.source.cursor()
        self.changed = self.end
        for rows in follow(self.source, self._cursor, align=FIRST):
            pull = self._taken(rows)
            if pull.fresh:
                self.levelled = sorted(columns)
                self._pyramid = Pyramid(len(self.levelled))
                self.generation += 1
                self.revision, self.changed = (pull.revision if self._minus is None else running), 0
            if len(pull.events):
                self._pyramid.update(pull.first, pull.events.t, self._values(pull, self.levelled))
                self.changed = min(self.changed, pull.changed)
            self.end = pull.first + len(pull.events)
        self._pyramid.forget(pull.oldest)

    def span(self, since: int, until: int) -> tuple[int, int]:
        """Return absolute indices of the rows between two times, ns: the first, and the one after the last."""
        return self.source.index_at(since), self.source.index_at(until)

    def groups(self, size: int, start: int, stop: int, columns: list[str]) -> Groups:
        """Return groups of `size` rows with numbers from `start` to before `stop`."""
        if size < FIRST:
            pull = self._taken(self.source.rows(start * size, min(stop * size, self.end)))
            return grouped(size, pull.first, pull.events.t, self._values(pull, columns))
        groups = self._pyramid.level(size).part(start, stop)
        picked = [self.levelled.index(name) for name in columns]
        return groups._replace(low=groups.low[:, picked], high=groups.high[:, picked], rising=groups.rising[:, picked])

    def samples(self, groups: Groups, columns: list[str], count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return `count` measurements of each group at random, or all where there are no more.

        Which are taken depends on their indices alone, so a chart does not shimmer.

        Returns:
            Times (k, count), ns, ascending; values (k, count, columns), NaN where a group has no such measurement.
        """
        part = min(groups.size, MAX_PULL_ROWS)
        each = max(1, count * part // groups.size)
        n = groups.n * (groups.size // part)
        times, values = np.zeros((n, each), np.int64), np.full((n, each, len(columns)), np.nan)
        origin = groups.start * groups.size
        stop = min(origin + n * part, self.end)
        for start in range(origin, stop, MAX_PULL_ROWS):
            pull = self.source.rows(start, min(start + MAX_PULL_ROWS, stop))
            rows = np.flatnonzero(pull.events.kind == READING)
            index = pull.first + rows
            of = (index - origin) // part
            order = np.lexsort((_mixed(index), of))
            kept = np.sort(order[_ranks(of) < each])
            rows, of = rows[kept], of[kept]
            events, track = pull.events.select(rows), pull.track.select(rows)
            place = of, _ranks(of)
            times[place] = events.t
            values[place] = self._values(replace(pull, events=events, track=track), columns)
        times, values = times.reshape(groups.n, -1), values.reshape(groups.n, -1, len(columns))
        times = np.maximum.accumulate(np.maximum(times, groups.first[:, None]), axis=1)
        return times, values

    def _taken(self, pull: Pull) -> Pull:
        return pull if self._minus is None else less(pull, self._minus)

    def _values(self, pull: Pull, names: list[str]) -> np.ndarray:
        """Return columns of rows, (n, columns)."""
        # Each column in one piece: they are filled, and grouped, one after the other.
        out, rows = np.empty((len(pull.events), len(names)), order="F"), Rows(pull.events, pull.track)
        for k, name in enumerate(names):
            out[:, k] = self._columns[name].of(rows)
        return out


def _ranks(ascending: np.ndarray) -> np.ndarray:
    """Return of each value how many equal ones lie before it."""
    return np.arange(ascending.size) - np.searchsorted(ascending, ascending)


def _mixed(index: np.ndarray) -> np.ndarray:
    """Return a random number for each index (SplitMix64: Steele, Lea and Flood 2014)."""
    z = (index.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def less(pull: Pull, engine: Running) -> Pull:
    """Return rows with means less those of the running fold, NaN where it has no such row."""
    mean = np.full_like(pull.track.mean, np.nan)
    for start in range(0, len(mean), MAX_PULL_ROWS):
        live = engine.rows(pull.first + start, pull.first + min(start + MAX_PULL_ROWS, len(mean)))
        at = live.first - pull.first
        rows = slice(at, at + len(live.events))
        # The log may have begun again: a row of the same number at another time is another.
        same = (live.events.t == pull.events.t[rows]) & estimated_rows(live.track)
        mean[rows] = np.where(same[:, None], pull.track.mean[rows] - live.track.mean, np.nan)
    mean = wrapped(mean, [state.circular for state in engine.model.shown_states])
    return replace(pull, track=pull.track._replace(mean=mean))
