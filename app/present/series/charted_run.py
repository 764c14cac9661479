"""A kept revision less what runs, row by row."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol

import numpy as np

from estimators.track import estimated_rows

from ...live.outputs import Cursor, Pull
from ...live.running_fold import Running
from .columns import Column, Rows
from .levels_of_detail import FIRST, Groups, Pyramid, grouped


class DifferenceRun:
    """See `Run`. Means are differences, NaN where what runs has no such row; other columns are the kept ones."""

    def __init__(self, pull: Pull, columns: dict[str, Column], engine: Running) -> None:
        self.of, self._columns, self._engine = pull, columns, engine
        self._kept = KeptRun(pull, columns)
        self.revision, self.generation = -1, 0
        self.end = self.changed = self._kept.end

    def sync(self, columns: Iterable[str]) -> None:
        """See `Run`. Another revision runs: all rows are others."""
        revision = self._engine.revisions.runs[-1].number
        if revision != self.revision:
            self._kept = KeptRun(replace(less(self.of, self._engine), revision=revision), self._columns)
            self.revision = revision
            self.generation += 1
        self._kept.sync(columns)

    def span(self, since: int, until: int) -> tuple[int, int]:
        """See `Run`."""
        return self._kept.span(since, until)

    def groups(self, size: int, start: int, stop: int, columns: list[str]) -> Groups:
        """See `Run`."""
        return self._kept.groups(size, start, stop, columns)


def less(pull: Pull, engine: Running) -> Pull:
    """Rows with means less those of what runs, NaN where that has no such row."""
    mean = np.full_like(pull.track.mean, np.nan)
    for start in range(0, len(mean), ROWS):
        stop = min(start + ROWS, len(mean))
        live = engine.rows(pull.first + start, pull.first + stop)
        at = live.first - pull.first
        rows = slice(at, at + len(live.events))
        # The log may have begun again: a row of the same number at another time is another.
        same = (live.events.t == pull.events.t[rows]) & estimated_rows(live.track)
        mean[rows] = np.where(same[:, None], pull.track.mean[rows] - live.track.mean, np.nan)
    for j, state in enumerate(engine.model.shown_states):
        if state.circular:
            mean[:, j] = (mean[:, j] + np.pi) % (2.0 * np.pi) - np.pi
    return replace(pull, track=pull.track._replace(mean=mean))


ROWS = 16_384
"""Rows pulled at once, so that a long history does not hold the engine's lock for long."""


class Run(Protocol):
    """Rows of a fold by absolute index, and their levels of detail."""

    revision: int
    generation: int
    """Counts up when all rows are to be looked at again: of another revision or log, or for another column."""
    end: int
    changed: int
    """First row that changed in the last `sync`; `end` if none did."""

    def sync(self, columns: Iterable[str]) -> None:
        """Take the rows that came, and bring the levels of these columns up to date."""

    def span(self, since: int, until: int) -> tuple[int, int]:
        """Absolute indices of the rows between two times, ns: the first, and the one after the last, synced or not."""

    def groups(self, size: int, start: int, stop: int, columns: list[str]) -> Groups:
        """Groups of `size` rows with numbers from `start` to before `stop`."""


class Levels:
    """The columns that somebody asked for, and their pyramid."""

    def __init__(self, columns: dict[str, Column]) -> None:
        self.known = columns
        self.asked: list[str] = []
        self.pyramid = Pyramid(0)

    def ask(self, names: Iterable[str]) -> bool:
        """Ask for columns; whether that were new ones, so that all rows are to be taken again."""
        new = [name for name in names if name in self.known and name not in self.asked]
        if new:
            self.asked = sorted({*self.asked, *new})
        return bool(new)

    def clear(self, names: Iterable[str] | None = None) -> None:
        """Forget the rows, and all columns but these."""
        if names is not None:
            self.asked = sorted(name for name in names if name in self.known)
        self.pyramid = Pyramid(len(self.asked))

    def take(self, pull: Pull) -> None:
        """Take rows that are new or rewritten."""
        self.pyramid.update(pull.first, pull.events.t, self.values(pull, self.asked))

    def values(self, pull: Pull, names: list[str]) -> np.ndarray:
        """Columns of rows, (n, columns)."""
        # Each column in one piece: they are filled, and grouped, one after the other.
        out, rows = np.empty((len(pull.events), len(names)), order="F"), Rows(pull.events, pull.track)
        for k, name in enumerate(names):
            out[:, k] = self.known[name].of(rows)
        return out

    def part(self, size: int, start: int, stop: int, names: list[str]) -> Groups:
        """Groups of `size` rows, with numbers from `start` to before `stop`."""
        groups = self.pyramid.level(size).part(start, stop)
        picked = [self.asked.index(name) for name in names]
        return groups._replace(low=groups.low[:, picked], high=groups.high[:, picked], rising=groups.rising[:, picked])


class LiveRun:
    """Rows of the running fold. Not thread-safe."""

    def __init__(self, engine: Running, columns: dict[str, Column]) -> None:
        self._engine, self._levels = engine, Levels(columns)
        self._cursor: Cursor = engine.cursor()
        self.revision = -1
        self.generation = self.changed = self.end = 0

    def close(self) -> None:
        """Give the cursor back."""
        self._engine.release(self._cursor)

    def sync(self, columns: Iterable[str]) -> None:
        """See `Run`. Columns whose levels are wanted no more cost nothing from the next revision on."""
        columns = set(columns)
        if self._levels.ask(columns):
            self._engine.release(self._cursor)
            self._cursor = self._engine.cursor()
        self.changed = self.end
        while True:
            pull = self._engine.pull(self._cursor, ROWS, align=FIRST)
            if pull.fresh:
                self._levels.clear(columns)
                self.generation += 1
                self.revision, self.changed = pull.revision, 0
            if len(pull.events):
                self._levels.take(pull)
                self.changed = min(self.changed, pull.changed)
            self.end = pull.first + len(pull.events)
            if len(pull.events) < ROWS:
                self._levels.pyramid.forget(pull.oldest)
                return

    def span(self, since: int, until: int) -> tuple[int, int]:
        """See `Run`."""
        return self._engine.index_at(since), self._engine.index_at(until)

    def groups(self, size: int, start: int, stop: int, columns: list[str]) -> Groups:
        """See `Run`."""
        if size >= FIRST:
            return self._levels.part(size, start, stop, columns)
        pull = self._engine.rows(start * size, min(stop * size, self.end))
        return grouped(size, pull.first, pull.events.t, self._levels.values(pull, columns))


class KeptRun:
    """A revision that was kept whole: the previous one, or one that was pinned. Its arrays never change."""

    def __init__(self, pull: Pull, columns: dict[str, Column]) -> None:
        self.of, self._levels = pull, Levels(columns)
        self.revision, self.generation = pull.revision, 0
        self.end = self.changed = pull.first + len(pull.events)

    def sync(self, columns: Iterable[str]) -> None:
        """See `Run`."""
        if self._levels.ask(columns):
            self._levels.clear()
            self._levels.take(self.of)

    def span(self, since: int, until: int) -> tuple[int, int]:
        """See `Run`."""
        start, stop = np.searchsorted(self.of.events.t, (since, until))
        return self.of.first + int(start), self.of.first + int(stop)

    def groups(self, size: int, start: int, stop: int, columns: list[str]) -> Groups:
        """See `Run`."""
        if size >= FIRST:
            return self._levels.part(size, start, stop, columns)
        first = self.of.first
        rows = slice(max(0, start * size - first), max(0, stop * size - first))
        part = Pull(self.revision, False, first + rows.start, self.of.events.select(rows), self.of.track.select(rows))
        return grouped(size, part.first, part.events.t, self._levels.values(part, columns))
