"""The backward pass over a fold: each stretch between snapshots is folded again with notes, then gone back over.

Memory holds the fold's snapshots and the notes of one batch of stretches, whatever the log's length. A change of the
state from outside the filter ends a stretch: a maintenance, or a covariance that was widened.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from ..fold import Fold
from ..gate.isolation import BELIEVED, REOPENED
from ..log import MAINTENANCE, MARK, TICK, TRUTH
from ..snapshots import Snapshot
from ..track import Track

BATCH_BYTES = 32 * 2**20
"""Bytes of the notes of one batch, and of the states between batches; at least one event is noted at a time."""


MIN_STATION_EVENTS = 512
"""Fewest events between two stations, if their notes fit: the last snapshots are closer than it pays."""


QUERIES = (TRUTH, TICK, MARK)


class Stretch(NamedTuple):
    """Events from row `start` to `stop` that are folded in one go.

    A `sensor` is accepted for all of them, and the covariance widened before the first. If the only event is a
    maintenance, its `state` restarts. -1 for none.
    """

    start: int
    stop: int
    sensor: int = -1
    state: int = -1


class StateJump(NamedTuple):
    """Change of N(mean, cov) from outside: `added` variances (nx,), or the restart of a `state`."""

    mean: np.ndarray
    cov: np.ndarray
    added: np.ndarray | None = None
    state: int = -1


class Notes(Protocol):
    """Takes notes of stretches, and goes back over them."""

    each: int
    """Bytes of the notes of one event."""

    def room(self, events: int) -> None:
        """Allocate the notes of so many events."""

    def forward(self, part: Stretch, now: Snapshot, row: int) -> np.ndarray:
        """Fold a stretch with notes from a row on, advancing `now`; return the state that answered the last query."""

    def back(self, part: Stretch, row: int, before: Snapshot, jump: StateJump | None) -> None:
        """Go back over a stretch whose notes begin at a row; `before` is the state before it."""


class Walk:
    """Backward pass over one fold."""

    def __init__(self, fold: Fold, notes: Notes) -> None:
        self._fold, self._notes, self._log, self._machine = fold, notes, fold.log, fold.machine
        first, names = fold.log.first, fold.model.sensor_names
        told = [decision for decision in fold.decisions if decision.outcome in (REOPENED, BELIEVED)]
        self._stories = [Stretch(d.first - first, d.row - first + 1, sensor=names.index(d.sensor)) for d in told]
        self._most = max(1, BATCH_BYTES // notes.each)
        longest = max((story.stop - story.start for story in self._stories), default=1)
        notes.room(max(min(self._most, fold.n), longest))

    def back(self) -> None:
        """Go back over all events."""
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
        """Return rows with a snapshot before them, between which to go back; the first row, and the end."""
        first, n = self._log.first, self._fold.n
        chosen = [n]
        for row in reversed([at - first for at in self._fold.snapshots.places]):
            # Within events that were folded a second time the snapshots are those of the first time.
            told = any(story.start < row < story.stop for story in self._stories)
            if row < n and (row == 0 or (not told and chosen[-1] - row >= min(MIN_STATION_EVENTS, self._most))):
                chosen.append(row)
        return chosen[::-1]

    def _stretches(self, start: int, stop: int) -> list[Stretch]:
        """Return the rows between two stations in stretches whose notes fit."""
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
        """Go back over batches; only as many states before them are kept as fit."""
        if len(batches) == 1:
            self._batch(batches[0], now)
            return
        each = -(-len(batches) // max(2, BATCH_BYTES // now.state.nbytes))
        groups = [batches[k : k + each] for k in range(0, len(batches), each)]
        begins = [now.copy()]
        for group in groups[:-1]:
            for part in [part for batch in group for part in batch]:
                self._fold_on(part, now)
            begins.append(now.copy())
        for group, begin in zip(reversed(groups), reversed(begins), strict=True):
            self._batches(group, begin)

    def _batch(self, parts: list[Stretch], now: Snapshot) -> None:
        """Go back over stretches whose notes fit."""
        first = parts[0].start
        noted = []
        for part in parts:
            before = now.copy()
            noted.append((part, before, self._fold_on(part, now, part.start - first)))
        for part, before, jump in reversed(noted):
            self._notes.back(part, part.start - first, before, jump)

    def _fold_on(self, part: Stretch, now: Snapshot, row: int | None = None) -> StateJump | None:
        """Fold a stretch, noted from a row on if one is given; return the change from outside."""
        machine = self._machine
        if part.sensor >= 0:
            begun = machine.moments(now.state)
            added = machine.widen(now, part.sensor, self._fold.track.innovation[part.start])
            with machine.open(part.sensor):
                self._run(part, now, row)
            return StateJump(*begun, added=added)
        spare = self._run(part, now, row)
        if part.state < 0:
            return None
        mean, cov = machine.moments(spare)
        machine.maintain(mean, cov, part.state, int(self._log.t[part.start]), now)
        return StateJump(mean, cov, state=part.state)

    def _run(self, part: Stretch, now: Snapshot, row: int | None) -> np.ndarray:
        """Fold events; return the state that answered the last query."""
        if row is not None:
            return self._notes.forward(part, now, row)
        return self._machine.run_apart(self._log, part.start, part.stop, now, judged=False)[1]


class Smoothed(NamedTuple):
    """Smoothed columns of N rows, as in `Track`: mean, std (N, shown); cross (N, pairs)."""

    mean: np.ndarray
    std: np.ndarray
    cross: np.ndarray

    @staticmethod
    def room_for(fold: Fold) -> Smoothed:
        """Return columns to be filled."""
        shape = fold.n, len(fold.model.shown)
        return Smoothed(np.empty(shape), np.empty(shape), np.empty((fold.n, len(fold.pairs))))

    def select(self, part: slice) -> Smoothed:
        """Return the moments of some rows."""
        return Smoothed(*(column[part] for column in self))

    def instead_of(self, track: Track) -> Track:
        """Return the fold's track with these moments in place of its own, and of their bands."""
        return track._replace(mean=self.mean, std=self.std, cross=self.cross, factor=np.ones_like(track.factor))
