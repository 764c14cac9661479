"""The log: everything the asset said, in order of the time at which it was measured."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

READING, INPUT, TRUTH, TICK, RESET = range(5)
"""Kinds of event: a sensor's reading; inputs; a true state (scored, never used); a query; back to the prior."""

BEFORE = -(2**62)
"""Earlier than any event, and far enough from the end of int64 that a horizon can be taken off."""

KIND_NAMES = ("reading", "input", "truth", "tick", "reset")


class Readings(NamedTuple):
    """A batch of events in the order of arrival; columns of one length N.

    `channel` is the sensor's index for a reading, the first state's for a truth, else 0. `value` (N, width) holds a
    reading's rows, all inputs, or the true values of the states channel, channel + 1, ...; NaN is a row that is
    missing, an input that stays, or a state whose truth is not known.
    """

    t: np.ndarray
    arrival: np.ndarray
    kind: np.ndarray
    channel: np.ndarray
    value: np.ndarray

    @staticmethod
    def empty(width: int) -> Readings:
        """A batch without events."""
        none = np.zeros(0, np.int64)
        return Readings(none, none, np.zeros(0, np.int8), np.zeros(0, np.int32), np.zeros((0, width)))

    @staticmethod
    def one(t: int, arrival: int, kind: int, channel: int, values: object, width: int) -> Readings:
        """A batch of one event; `values` fill the first columns, the rest is NaN."""
        row = np.full((1, width), np.nan)
        given = np.atleast_1d(np.asarray(values, float))
        row[0, : given.size] = given
        return Readings(
            np.array([t], np.int64),
            np.array([arrival], np.int64),
            np.array([kind], np.int8),
            np.array([channel], np.int32),
            row,
        )

    @staticmethod
    def concat(batches: list[Readings], width: int) -> Readings:
        """Batches one after the other."""
        if not batches:
            return Readings.empty(width)
        wide = [batch.widened(width) for batch in batches]
        return Readings(*(np.concatenate(columns) for columns in zip(*wide, strict=True)))

    def widened(self, width: int) -> Readings:
        """The same events with at least `width` value columns; those that are added know nothing."""
        missing = width - self.value.shape[1]
        if missing <= 0:
            return self
        return Readings(*self[:4], np.pad(self.value, ((0, 0), (0, missing)), constant_values=np.nan))

    def select(self, index: Any) -> Readings:
        """The events that a mask, slice or index array picks."""
        return Readings(*(column[index] for column in self))

    def __len__(self) -> int:
        """Number of events (not of columns)."""
        return self.t.size


# What `_replace` builds with; NamedTuple's own counts the columns by `len`, which here is the number of events.
Readings._make = classmethod(lambda cls, columns: cls(*columns))  # type: ignore[method-assign, assignment]


def truth_of(events: Readings, state: int) -> tuple[np.ndarray, np.ndarray]:
    """What the truth events know of one state.

    Args:
        events: Any events.
        state: Index of the state.

    Returns:
        Indices of the events that know it, ascending, shape (k,), and its finite true values, shape (k,).
    """
    channel = events.channel
    blocks = (events.kind == TRUTH) & (channel <= state) & (channel > state - events.value.shape[1])
    rows = np.flatnonzero(blocks)
    values = events.value[rows, state - channel[rows]]
    known = np.isfinite(values)
    return rows[known], values[known]


class Log:
    """A bounded, columnar log in order of measured time; events of equal time stay in the order of arrival.

    Timestamps are int64 nanoseconds. `first` counts the events that were dropped from the front, so `first + i` names
    an event for ever. Columns are full-length arrays of which the first `n` rows are valid.
    """

    def __init__(self, width: int, capacity: int = 1024) -> None:
        self.width = width
        self.n = 0
        self.first = 0
        self.newest = BEFORE
        # Filled, not empty: the pages are paid for now, and memory stays flat while the log fills.
        self.t = np.full(capacity, 0, np.int64)
        self.arrival = np.full(capacity, 0, np.int64)
        self.kind = np.full(capacity, 0, np.int8)
        self.channel = np.full(capacity, 0, np.int32)
        self.value = np.full((capacity, width), np.nan)

    @property
    def capacity(self) -> int:
        """Events that fit before the log must grow or drop."""
        return self.t.size

    @property
    def readings(self) -> Readings:
        """Views of the valid rows."""
        return Readings(*(column[: self.n] for column in self._columns()))

    def _columns(self) -> tuple[np.ndarray, ...]:
        return self.t, self.arrival, self.kind, self.channel, self.value

    def extend(self, batch: Readings, horizon: int | None = None) -> tuple[int, int]:
        """Put a batch where it belongs in time.

        Args:
            batch: Events in the order of arrival, with at most `width` value columns.
            horizon: Nanoseconds; an event older than the newest before it by more than this is dropped as stale.
                Judged event by event, so the outcome does not depend on how arrivals were cut into batches.

        Returns:
            The lowest index whose event changed (the old `n` if all were appended) and the number dropped.
        """
        if not len(batch):
            return self.n, 0
        # Assigned as it is, a single column would be repeated in all, and a true value become that of other states.
        batch = batch.widened(self.width)
        # A tick says nothing of the asset, so nothing is late because of it.
        said = np.where(batch.kind == TICK, self.newest, batch.t)
        newest = np.maximum(np.maximum.accumulate(said), self.newest)
        self.newest = int(newest[-1])
        stale = 0
        if horizon is not None:
            fresh = batch.t >= newest - horizon
            stale = int(fresh.size - fresh.sum())
            if stale:
                batch = batch.select(fresh)
                if not len(batch):
                    return self.n, stale
        if np.any(batch.t[1:] < batch.t[:-1]):
            batch = batch.select(np.argsort(batch.t, kind="stable"))
        self._reserve(len(batch))
        start, n, end = self.n, self.n, self.n + len(batch)
        if n and batch.t[0] < self.t[n - 1]:
            start = int(np.searchsorted(self.t[:n], batch.t[0], side="right"))
            order = np.argsort(np.concatenate((self.t[start:n], batch.t)), kind="stable")
            for column, new in zip(self._columns(), batch, strict=True):
                column[start:end] = np.concatenate((column[start:n], new))[order]
        else:
            for column, new in zip(self._columns(), batch, strict=True):
                column[n:end] = new
        self.n = end
        return start, stale

    def _reserve(self, extra: int) -> None:
        need = self.n + extra
        if need <= self.capacity:
            return
        capacity = max(need, 2 * self.capacity)
        fresh = Log(self.width, capacity)
        for new, old in zip(fresh._columns(), self._columns(), strict=True):
            new[: self.n] = old[: self.n]
        self.t, self.arrival, self.kind, self.channel, self.value = fresh._columns()

    def drop_front(self, count: int) -> None:
        """Forget the oldest `count` events."""
        for column in self._columns():
            column[: self.n - count] = column[count : self.n].copy()
        self.n -= count
        self.first += count

    def copy(self) -> Log:
        """A log of its own with the same events, for a fold that runs beside the one that grows."""
        twin = Log(self.width, max(1, self.n))
        for new, old in zip(twin._columns(), self._columns(), strict=True):
            new[: self.n] = old[: self.n]
        twin.n, twin.first, twin.newest = self.n, self.first, self.newest
        return twin
