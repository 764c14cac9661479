"""The way back over a fold: from snapshot to snapshot, each stretch folded again forward with notes taken, then back.

What is kept at a time are the fold's snapshots and the notes of one batch of stretches, whatever the log's length. What
happened to the state from outside the filter ends a stretch: a part that was changed, a twin that was found wrong.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from ..fold import Fold
from ..gate.isolation import BELIEVED, REOPENED
from ..log import MAINTENANCE, MARK, TICK, TRUTH
from ..snapshots import Snapshot
from ..track import Track

ROOM = 32 * 2**20
"""Bytes that the notes of one batch may take, and the states between batches; one event is noted at a time at least."""

FEWEST = 512
"""Events between two stations, where their notes have room: the last snapshots are closer than it pays."""

QUERIES = (TRUTH, TICK, MARK)


class Stretch(NamedTuple):
    """Events from row `start` to `stop` that are folded in one go.

    A `sensor` is let in for all of them, and the covariance widened before the first. Of the only event, a maintenance,
    the `state` begins again behind it. -1 for none.
    """

    start: int
    stop: int
    sensor: int = -1
    state: int = -1


class Jump(NamedTuple):
    """What happened to N(mean, cov) from outside: `added` variances (nx,), or that `state` began again."""

    mean: np.ndarray
    cov: np.ndarray
    added: np.ndarray | None = None
    state: int = -1


class Notes(Protocol):
    """Takes notes of stretches, and goes back over them."""

    each: int
    """Bytes that the notes of one event take."""

    def room(self, events: int) -> None:
        """Make room for the notes of so many events."""

    def take(self, part: Stretch, now: Snapshot, row: int) -> np.ndarray:
        """Fold a stretch with notes from a row on: `now` moves on; the state from which the last query was answered."""

    def back(self, part: Stretch, row: int, before: Snapshot, jump: Jump | None) -> None:
        """Go back over a stretch, whose notes begin at a row; `before` is the state before it."""


class Walk:
    """The way back over one fold."""

    def __init__(self, fold: Fold, notes: Notes) -> None:
        self._fold, self._notes, self._log, self._machine = fold, notes, fold.log, fold.machine
        first, names = fold.log.first, fold.model.sensor_names
        told = [decision for decision in fold.decisions if decision.outcome in (REOPENED, BELIEVED)]
        self._stories = [Stretch(d.first - first, d.row - first + 1, sensor=names.index(d.sensor)) for d in told]
        self._most = max(1, ROOM // notes.each)
        longest = max((story.stop - story.start for story in self._stories), default=1)
        notes.room(max(min(self._most, fold.n), longest))

    def back(self) -> None:
        """All of it."""
        stations = self._stations()
        for start, stop in reversed(list(zip(stations, stations[1:], strict=False))):
            batches: list[list[Stretch]] = []
            for part in self._stretches(start, stop):
                if batches and part.stop - batches[-1][0].start <= self._most:
                    batches[-1].append(part)
                else:
                    batches.append([part])
            self._batches(batches, self._fold.snapshots[self._log.first + start].copy())

    def _stations(self) -> list[int]:
        """Rows with a snapshot before them, between which to go back; the first, and the end."""
        first, n = self._log.first, self._fold.n
        chosen = [n]
        for row in reversed([at - first for at in self._fold.snapshots.places]):
            # Within a story that was told again the snapshots are those of the first.
            told = any(story.start < row < story.stop for story in self._stories)
            if row < n and (row == 0 or (not told and chosen[-1] - row >= min(FEWEST, self._most))):
                chosen.append(row)
        return chosen[::-1]

    def _stretches(self, start: int, stop: int) -> list[Stretch]:
        """The rows between two stations in pieces that are folded in one go, and for whose notes there is room."""
        kind, channel = self._log.kind, self._log.channel
        apart = [story for story in self._stories if start <= story.start < stop]
        apart += [
            Stretch(row, row + 1, state=int(channel[row]))
            for row in (start + np.flatnonzero(kind[start:stop] == MAINTENANCE)).tolist()
            if not any(story.start <= row < story.stop for story in self._stories)
        ]
        parts, at = [], start
        for part in [*sorted(apart), Stretch(stop, stop)]:
            edges = [*range(at, part.start, self._most), part.start]
            parts += [Stretch(a, b) for a, b in zip(edges, edges[1:], strict=False)]
            parts += [part] if part.start < stop else []
            at = part.stop
        return parts

    def _batches(self, batches: list[list[Stretch]], now: Snapshot) -> None:
        """Go back over batches; of the states before them no more are kept than there is room."""
        if len(batches) == 1:
            self._batch(batches[0], now)
            return
        each = -(-len(batches) // max(2, ROOM // now.state.nbytes))
        groups = [batches[k : k + each] for k in range(0, len(batches), each)]
        begins = [now.copy()]
        for group in groups[:-1]:
            for part in [part for batch in group for part in batch]:
                self._fold_on(part, now)
            begins.append(now.copy())
        for group, begin in zip(reversed(groups), reversed(begins), strict=True):
            self._batches(group, begin)

    def _batch(self, parts: list[Stretch], now: Snapshot) -> None:
        """Go back over stretches for whose notes there is room."""
        first = parts[0].start
        noted = []
        for part in parts:
            before = now.copy()
            noted.append((part, before, self._fold_on(part, now, part.start - first)))
        for part, before, jump in reversed(noted):
            self._notes.back(part, part.start - first, before, jump)

    def _fold_on(self, part: Stretch, now: Snapshot, row: int | None = None) -> Jump | None:
        """Fold a stretch, noted from a row on if one is given; what happened from outside."""
        machine = self._machine
        if part.sensor >= 0:
            begun = machine.moments(now.state)
            added = machine.widen(now, part.sensor, self._fold.track.innovation[part.start])
            with machine.open(part.sensor):
                self._run(part, now, row)
            return Jump(*begun, added=added)
        spare = self._run(part, now, row)
        if part.state < 0:
            return None
        mean, cov = machine.moments(spare)
        machine.maintain(mean, cov, part.state, int(self._log.t[part.start]), now)
        return Jump(mean, cov, state=part.state)

    def _run(self, part: Stretch, now: Snapshot, row: int | None) -> np.ndarray:
        """Fold events; the state from which the last query was answered."""
        if row is not None:
            return self._notes.take(part, now, row)
        return self._machine.run_apart(self._log, part.start, part.stop, now)[1]


class Smoothed(NamedTuple):
    """Columns of one length N, as `Track` has them: mean, std (N, shown); cross (N, pairs)."""

    mean: np.ndarray
    std: np.ndarray
    cross: np.ndarray

    @staticmethod
    def room_for(fold: Fold) -> Smoothed:
        """Columns to be filled."""
        shape = fold.n, len(fold.model.shown)
        return Smoothed(np.empty(shape), np.empty(shape), np.empty((fold.n, len(fold.pairs))))

    def instead_of(self, track: Track) -> Track:
        """The fold's track with these moments in the place of its own."""
        return track._replace(mean=self.mean, std=self.std, cross=self.cross)
