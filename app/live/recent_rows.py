"""The last rows of a log and its track, copied: what the chronicle looks at, and no more memory than that."""

from __future__ import annotations

from typing import Any

import numpy as np

from estimators.log import READING, Events
from estimators.model.state_space import StateSpaceModel
from estimators.track import Track

from .outputs import Pull

ROWS = 65_536
"""Rows that are kept at most; at least half of them once there were so many."""

MEMORY = 64 * 2**20
"""Bytes that they may take; rows of a large field are fewer."""


class Tail:
    """Rows from the absolute index `first` on."""

    def __init__(self, model: StateSpaceModel, rows: int = ROWS) -> None:
        self._most = rows
        self._sensors = len(model.sensors)
        self.begin(0)

    def begin(self, first: int) -> None:
        """Forget everything; the next row is `first`."""
        self.first, self.n = first, 0
        self._columns: list[np.ndarray] = []
        self.heard = np.zeros(self._sensors, np.int64)
        """When each sensor spoke last before these rows, ns, or 0."""

    @property
    def events(self) -> Events:
        """Views of the events."""
        return Events(*(column[: self.n] for column in self._columns[:5]))

    @property
    def track(self) -> Track:
        """Views of their rows."""
        return Track(*(column[: self.n] for column in self._columns[5:]))

    @property
    def full(self) -> bool:
        """Whether the older half should be cut off."""
        return self.n >= self._room

    def put(self, pull: Pull) -> None:
        """Take rows that follow, or that take the place of the last ones."""
        new: list[Any] = [*pull.events, *pull.track]
        if not self._columns:
            row = sum(column[:1].nbytes for column in new)
            self._room = max(2, min(self._most, MEMORY // max(1, row)))
            self._columns = [column[:0] for column in new]
        at = pull.first - self.first
        end = at + len(pull.events)
        for k, column in enumerate(new):
            # A reading that brings variances of its own makes events wider.
            if end > len(self._columns[k]) or column.shape[1:] > self._columns[k].shape[1:]:
                shape = (max(end, 2 * at), *max(self._columns[k].shape[1:], column.shape[1:]))
                wider = np.zeros(shape, column.dtype)
                _put(self._columns[k][:at], wider)
                self._columns[k] = wider
            _put(column, self._columns[k][at:end])
        self.n = end

    @property
    def cut_at(self) -> int:
        """Where the older half ends."""
        return self.n // 2

    def cut(self) -> None:
        """Cut the older half off."""
        count = self.cut_at
        kind, channel, t = self.events.kind[:count], self.events.channel[:count], self.events.t[:count]
        reading = kind == READING
        # Ascending in time: the last of equal indices is what stays.
        self.heard[channel[reading]] = t[reading]
        for column in self._columns:
            column[: self.n - count] = column[count : self.n].copy()
        self.first, self.n = self.first + count, self.n - count


def _put(column: np.ndarray, to: np.ndarray) -> None:
    """Copy rows to the first ones of another column, which may be wider: that knows nothing there."""
    if column.ndim == 1:
        to[: len(column)] = column
        return
    to[: len(column), : column.shape[1]] = column
    if column.shape[1] < to.shape[1]:
        to[: len(column), column.shape[1] :] = np.nan
