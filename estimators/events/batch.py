"""Events of an asset, one row each, as columns of one length."""

from __future__ import annotations

from operator import index
from typing import NamedTuple, SupportsIndex

import numpy as np

from ..errors import EventError

READING, INPUT, TRUTH, TICK, RESET, MARK, MAINTENANCE = range(7)
"""Kinds of event: a measurement of a sensor; inputs; a true state (scored, never used); a query; a reset to the prior;
start or end of an injected fault; maintenance, which resets the covariance of a state to the prior's."""

BEFORE = -(2**62)  # Earlier than any event, and far enough from the end of int64 to subtract a horizon

COLUMN_TYPES = {"t": np.int64, "arrival": np.int64, "kind": np.int8, "channel": np.int32}
"""Types of the first columns of `Events`; the last holds float64s."""

KIND_NAMES = ("reading", "input", "truth", "tick", "reset", "mark", "maintenance")


class Events(NamedTuple):
    """A batch of events in the order of arrival; columns of one length N.

    `channel` is the index of the sensor for a measurement, of the first state for a truth, of the state for
    maintenance, of a sensor, input (after the sensors) or the twin (after both) for a mark, else 0. `value` (N, width)
    holds the rows of a measurement, all inputs, or the true values of the states channel, channel + 1, ...; NaN is a
    missing row, an unchanged input, or an unknown true value. A mark's first value is the code of its fault, negative
    at the end of the fault.

    Columns of `value` beyond the width of the log hold variances: column width + k is the variance of the noise of row
    k of this measurement, in the row's unit squared; NaN leaves the tuned R.
    """

    t: np.ndarray
    arrival: np.ndarray
    kind: np.ndarray
    channel: np.ndarray
    value: np.ndarray

    @staticmethod
    def empty(width: int) -> Events:
        """Return a batch without events."""
        return Events.allocate(0, width)

    @staticmethod
    def allocate(rows: int, width: int) -> Events:
        """Return columns for so many events, not filled."""
        return Events._make([*(np.empty(rows, kind) for kind in COLUMN_TYPES.values()), np.empty((rows, width))])

    @staticmethod
    def one(t: int, arrival: int, kind: int, channel: int, values: object, width: int) -> Events:
        """Return a batch of one event; `values` fill the first columns, the rest is NaN.

        Raises:
            EventError: If a time or an index is not an integer, or the values are more than `width`.
        """
        row = np.full((1, width), np.nan)
        given = np.atleast_1d(np.asarray(values, float))
        if given.size > width:
            raise EventError(f"values are {given.size}; they must be {width} at most, the width of the log")
        row[0, : given.size] = given
        numbers = zip(COLUMN_TYPES.items(), (t, arrival, kind, channel), strict=True)
        return Events._make([*(np.array([_whole(name, number)], wanted) for (name, wanted), number in numbers), row])

    @staticmethod
    def alike(kind: int, t: np.ndarray, value: np.ndarray, channel: int | np.ndarray = 0) -> Events:
        """Return events of one kind at times t (n,), which arrive then; `value` is (n, width), or one column (n,)."""
        kinds, channels = np.full(t.size, kind, np.int8), np.full(t.size, channel, np.int32)
        return Events(t, t.copy(), kinds, channels, value[:, None] if value.ndim == 1 else value)

    @staticmethod
    def concat(batches: list[Events], width: int) -> Events:
        """Concatenate batches, with at least `width` value columns."""
        if not batches:
            return Events.empty(width)
        widest = max(width, *(batch.value.shape[1] for batch in batches))
        wide = [batch.widened(widest) for batch in batches]
        return Events(*(np.concatenate(columns) for columns in zip(*wide, strict=True)))

    def widened(self, width: int) -> Events:
        """Return the events with at least `width` value columns; added columns are NaN."""
        missing = width - self.value.shape[1]
        if missing <= 0:
            return self
        return Events(*self[:4], np.pad(self.value, ((0, 0), (0, missing)), constant_values=np.nan))

    def select(self, index: slice | np.ndarray) -> Events:
        """Return the events that a mask, slice or index array selects."""
        return Events(*(column[index] for column in self))

    def of_sensor(self, sensor: int) -> np.ndarray:
        """Return the indices of the measurements of a sensor."""
        return np.flatnonzero((self.kind == READING) & (self.channel == sensor))

    def copy(self) -> Events:
        """Return a copy."""
        return Events(*(column.copy() for column in self))

    @property
    def seconds(self) -> float:
        """Time from the first event to the last, s; 0 without events."""
        return float(self.t[-1] - self.t[0]) * 1e-9 if len(self) else 0.0

    def __len__(self) -> int:
        """Return the number of events (not of columns)."""
        return self.t.size


# What `_replace` builds with; NamedTuple's own counts the columns by `len`, which here is the number of events.
Events._make = classmethod(lambda cls, columns: cls(*columns))  # type: ignore[method-assign, assignment]


def _whole(name: str, value: SupportsIndex) -> int:
    """Return an integer; reject a float, whose decimals would be lost."""
    try:
        return index(value)
    except TypeError:
        remedy = f"for seconds write round({value} * 1e9)" if name in ("t", "arrival") else "give a whole number"
        unit = "a whole number of nanoseconds" if name in ("t", "arrival") else "an integer"
        raise EventError(f"{name} is {value!r}; it must be {unit}: {remedy}") from None


def truth_of(events: Events, state: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the true values of one state.

    Args:
        events: Events of any kind.
        state: Index of the state.

    Returns:
        Indices of the events with a finite true value of it, ascending, (k,), and the values, (k,).
    """
    channel = events.channel
    blocks = (events.kind == TRUTH) & (channel <= state) & (channel > state - events.value.shape[1])
    rows = np.flatnonzero(blocks)
    values = events.value[rows, state - channel[rows]]
    known = np.isfinite(values)
    return rows[known], values[known]
