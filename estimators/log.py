"""The log: everything the asset said, in order of the time at which it was measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import EventError
from .events import arrays
from .events.batch import (
    BEFORE,
    INPUT,
    KIND_NAMES,
    MAINTENANCE,
    MARK,
    READING,
    RESET,
    TICK,
    TRUTH,
    Events,
    truth_of,
)
from .events.checks import EventLayout, admitted
from .events.maintenance import versions_dropped

if TYPE_CHECKING:
    from .model.state_space import StateSpaceModel
    from .snapshots import Base

__all__ = [
    "BEFORE", "INPUT", "KIND_NAMES", "MAINTENANCE", "MARK", "READING", "RESET", "TICK", "TRUTH", "Log", "Events",
    "truth_of",
]  # fmt: skip


class Log:
    """A bounded, columnar log in the order of `sorted_order`: by measured time, and at one time by kind and channel.

    Timestamps are int64 nanoseconds. `first` counts the events that were dropped from the front, so `first + i` names
    an event for ever. Columns are full-length arrays of which the first `n` rows are valid. `changes` counts what was
    put in. `start` is the time at which the prior holds, `BEFORE` for that of the first event; an event before `floor`
    is stale: what it would change has been forgotten. `version` is the model's at the first event: it counts up with
    each maintenance that was dropped.
    """

    def __init__(self, width: int, capacity: int = 1024) -> None:
        self.width = width
        self.model: StateSpaceModel | None = None
        self.layout: EventLayout | None = None
        self.n = 0
        self.first = 0
        self.changes = 0
        self.version = 1
        self.newest = BEFORE
        self.start = self.floor = BEFORE
        self._allocate(capacity, width)

    @staticmethod
    def of(model: StateSpaceModel, *, start: float | None = None, capacity: int = 1024) -> Log:
        """An empty log of a model: it refuses what the model has no place for, and takes arrays by name.

        Args:
            model: The model whose sensors, inputs and states the events are of.
            start: Time at which the prior holds, s; None for that of the first event.
            capacity: Events that fit before it grows.

        Raises:
            EventError: If `start` is not a time.
        """
        log = Log(model.width, capacity)
        log.model, log.layout = model, model.layout
        if start is not None:
            log.start = log.floor = int(arrays.nanoseconds("start", start)[0])
        return log

    @staticmethod
    def resume(model: StateSpaceModel, base: Base | None, events: Events | None = None, *, capacity: int = 1) -> Log:
        """Return a log of a model that continues where a fold left a base.

        Args:
            model: The model whose sensors, inputs and states the events are of.
            base: Where the fold of this log begins; None for the prior.
            events: The events from there on; None for none yet.
            capacity: Events that fit before it grows, at least.

        Raises:
            EventError: If an event does not fit the model.
        """
        log = Log.of(model, capacity=max(1, capacity, 0 if events is None else len(events)))
        if base is not None:
            log.first, log.floor, log.version = base.first, base.clock, base.version
        if events is not None:
            log.extend(events)
        return log

    def _allocate(self, capacity: int, columns: int) -> None:
        # Filled, not empty: the pages are paid for now, and memory stays flat while the log fills.
        self.t = np.full(capacity, 0, np.int64)
        self.arrival = np.full(capacity, 0, np.int64)
        self.kind = np.full(capacity, 0, np.int8)
        self.channel = np.full(capacity, 0, np.int32)
        self.value = np.full((capacity, columns), np.nan)

    @property
    def capacity(self) -> int:
        """Events that fit before the log must grow or drop."""
        return self.t.size

    @property
    def events(self) -> Events:
        """Views of the valid rows."""
        return Events(*(column[: self.n] for column in self._columns()))

    @property
    def has_variances(self) -> bool:
        """Whether a reading came with variances of its own."""
        return self.value.shape[1] > self.width

    def _columns(self) -> tuple[np.ndarray, ...]:
        return self.t, self.arrival, self.kind, self.channel, self.value

    def add(self, sensor: str, seconds: Any, values: Any, *, variance: Any = None) -> int:
        """Put readings of one sensor where they belong.

        Args:
            sensor: Its name in the model.
            seconds: When they were measured, s, shape (N,) or one number; in any order.
            values: In the units of the sensor's rows, shape (N,), or (N, rows); NaN is missing.
            variance: The noise's variance of each, in the units squared, if they tell it (a receiver does); shape as
                `values`, or anything that can be broadcast to it. NaN leaves the tuned R.

        Returns:
            How many events the log has now.

        Raises:
            EventError: If the log is of no model, a name or a shape does not fit, or a time is before the start.
        """
        return self._put(arrays.readings(self._named("add"), sensor, seconds, values, variance))

    def add_inputs(self, seconds: Any, **inputs: Any) -> int:
        """Put inputs where they belong; each holds until its next value.

        Args:
            seconds: From when on they hold, s, shape (N,) or one number.
            **inputs: Values by name, in the inputs' units, shape (N,) or one number; NaN leaves the value before.

        Returns:
            How many events the log has now.

        Raises:
            EventError: As `add`.
        """
        return self._put(arrays.inputs(self._named("add_inputs"), seconds, inputs))

    def add_truth(self, seconds: Any, **states: Any) -> int:
        """Put true states where they belong: the estimate is scored against them, and never sees them.

        Args:
            seconds: When they held, s, shape (N,) or one number.
            **states: True values by name, in the states' units, shape (N,) or one number; NaN is not known.

        Returns:
            How many events the log has now.

        Raises:
            EventError: As `add`.
        """
        return self._put(arrays.truth(self._named("add_truth"), seconds, states))

    def add_ticks(self, seconds: Any) -> int:
        """Ask for the estimate at these times, s, shape (N,) or one number: each is a row of the track.

        Returns:
            How many events the log has now.

        Raises:
            EventError: If a time is not finite or before the start.
        """
        return self._put(arrays.ticks(self.width, seconds))

    def _named(self, method: str) -> StateSpaceModel:
        if self.model is None:
            raise EventError(f"{method}: this log is of no model, so it knows no names; make it by Log.of(model)")
        return self.model

    def _put(self, batch: Events) -> int:
        early = int(np.sum(batch.t < self.floor))
        if early:
            raise EventError(
                f"seconds: {early} of {len(batch)} times are before {self.floor * 1e-9:.9g} s, where the log starts; "
                "leave them out, or start the log earlier"
            )
        self.extend(batch)
        return self.n

    def extend(self, batch: Events, horizon: int | None = None, settled: np.ndarray | None = None) -> tuple[int, int]:
        """Put a batch where it belongs in time.

        Args:
            batch: Events in any order. Value columns beyond `width` hold variances, see `Events`.
            horizon: Nanoseconds; an event older than the newest before it by more than this is dropped as stale.
                Judged event by event, so the outcome does not depend on how arrivals were cut into batches. One
                before `floor` is stale with any horizon.
            settled: Mask (N,) of the events to which no horizon applies: they came in time and were held on the way.

        Returns:
            The lowest index whose event changed (the old `n` if all were appended) and the number dropped.

        Raises:
            EventError: If an event does not fit; then the log is as it was.
        """
        # Assigned as it is, a single column would be repeated in all, and a true value become that of other states.
        batch = admitted(batch, self.width, self.layout).widened(self.width)
        if not len(batch):
            return self.n, 0
        # A tick or a mark says nothing of the asset, so nothing is late because of it.
        said = np.where((batch.kind == TICK) | (batch.kind == MARK), self.newest, batch.t)
        newest = np.maximum(np.maximum.accumulate(said), self.newest)
        self.newest = int(newest[-1])
        stale = 0
        if horizon is not None or batch.t.min() < self.floor:
            oldest = np.full(len(batch), self.floor)
            if horizon is not None:
                oldest = np.maximum(newest - horizon, oldest)
            if settled is not None:
                oldest[settled] = self.floor
            fresh = batch.t >= oldest
            stale = int(fresh.size - fresh.sum())
            if stale:
                batch = batch.select(fresh)
                if not len(batch):
                    return self.n, stale
        if not in_order(batch):
            batch = batch.select(sorted_order(batch))
        self._reserve(len(batch), batch.value.shape[1])
        batch = batch.widened(self.value.shape[1])
        self.changes += 1
        return self._insert(batch), stale

    def _insert(self, batch: Events) -> int:
        """Merge a batch that is in order; the lowest index that changed."""
        n, end = self.n, self.n + len(batch)
        start = n
        if n and batch.t[0] <= self.t[n - 1]:
            start = int(np.searchsorted(self.t[:n], batch.t[0], side="left"))
        columns = self._columns()
        tail = batch if start == n else Events(*(np.concatenate((a[start:n], b)) for a, b in zip(columns, batch)))
        changed = n
        if start < n:
            order = sorted_order(tail)
            moved = np.flatnonzero(order != np.arange(order.size))
            if moved.size:
                changed = start + int(moved[0])
                tail = tail.select(order)
        for column, new in zip(columns, tail, strict=True):
            column[changed:end] = new[changed - start :]
        self.n = end
        return changed

    def _reserve(self, extra: int, columns: int) -> None:
        """Room for `extra` more events, and for variances where they are the first that bring any."""
        need, wide = self.n + extra, self.value.shape[1]
        if need <= self.capacity and columns <= wide:
            return
        if columns > wide and self.layout is not None:
            columns = max(columns, self.width + max(self.layout.rows))
        old = self._columns()
        self._allocate(self.capacity if need <= self.capacity else max(need, 2 * self.capacity), max(columns, wide))
        for new, column in zip(self._columns()[:4], old, strict=False):
            new[: self.n] = column[: self.n]
        self.value[: self.n, :wide] = old[4][: self.n]

    def drop_front(self, count: int) -> None:
        """Forget the oldest `count` events; what comes later of the time before their end is stale."""
        if count:
            self.floor = max(self.floor, int(self.t[count - 1]))
            self.version += versions_dropped(self.events, count)
        for column in self._columns():
            column[: self.n - count] = column[count : self.n].copy()
        self.n -= count
        self.first += count

    def copy(self) -> Log:
        """A log of its own with the same events, for a fold that runs beside the one that grows."""
        twin = Log(self.width, 1)
        twin.__dict__.update(self.__dict__)
        twin._allocate(max(1, self.n), self.value.shape[1])
        for new, old in zip(twin._columns(), self._columns(), strict=True):
            new[: self.n] = old[: self.n]
        return twin


_ORDER = (INPUT, READING, TRUTH, TICK, MARK, MAINTENANCE, RESET)
_RANK = np.array([_ORDER.index(kind) for kind in range(len(_ORDER))], np.int64) << 32


def in_order(events: Events) -> bool:
    """Whether each event comes after the one before it, with no two that only their values could order."""
    t = events.t
    if t.size < 2:
        return True
    later = t[1:] > t[:-1]
    if later.all():
        return True
    place = _RANK.take(events.kind) + events.channel
    return bool(np.all(later | ((t[1:] == t[:-1]) & (place[1:] > place[:-1]))))


def sorted_order(events: Events) -> np.ndarray:
    """Return the permutation (N,) that puts events in the order of a log, whatever the order of arrival.

    Events are ordered by time. At one time come the inputs first, as a measurement is predicted with the inputs that
    hold when it is taken; then the measurements; then queries, which do not change the estimate (true states, ticks,
    marks) and so see all measurements of their time; then maintenance, and a reset last. Events of one kind follow
    their channel: sensors in the order of the model. Several events of one kind, channel and time are ordered by their
    values, the smallest first and a missing one last; of two inputs at one time the larger holds. The order of arrival
    cannot decide that, as a late event would then count for more than the same event in time.
    """
    place = _RANK.take(events.kind) + events.channel
    order: np.ndarray = np.lexsort((place, events.t))
    t, at = events.t[order], place[order]
    if np.any((t[1:] == t[:-1]) & (at[1:] == at[:-1])):
        order = np.lexsort((*events.value.T[::-1], place, events.t))
    return order


def maintenance_times(log: Log) -> np.ndarray:
    """Times (ns) of the maintenances that the log has kept, ascending."""
    return np.unique(log.t[: log.n][log.kind[: log.n] == MAINTENANCE])


def model_version_at(log: Log, t: int) -> int:
    """The version of the model at time t, ns."""
    return log.version + int(np.searchsorted(maintenance_times(log), t, side="right"))


def last_maintenance(log: Log, t: int) -> int | None:
    """Time (ns) of the last maintenance at or before t that the log has kept; None if there is none."""
    times = maintenance_times(log)
    k = int(np.searchsorted(times, t, side="right"))
    return int(times[k - 1]) if k else None
