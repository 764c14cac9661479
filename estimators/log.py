"""The log: all events of an asset, ordered by the time at which they were measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .errors import EventError
from .events import arrays
from .events.batch import BEFORE, INPUT, KIND_NAMES, MAINTENANCE, MARK, READING, RESET, TICK, TRUTH, Events, truth_of
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

    Timestamps are int64 nanoseconds. Columns are full-length arrays of which the first `n` rows are valid. `first`
    counts the events dropped from the front, so the absolute index `first + i` of an event never changes. `changes`
    counts insertions. `start` is the time at which the prior holds, `BEFORE` for the time of the first event. An event
    before `floor` is stale, as the rows that it would change have been dropped. `version` is the version of the model
    at the first event.
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
        """Return an empty log of a model, which checks events against the model and takes arrays by name.

        Args:
            model: The model whose sensors, inputs and states the events are of.
            start: Time at which the prior holds, s; None for that of the first event.
            capacity: Events that fit before it grows.

        Raises:
            EventError: If `start` is not finite or beyond ±146 years.
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
        # Not filled: the system gives memory to the rows that have events, a tenth of the capacity of most twins.
        self.t, self.arrival, self.kind, self.channel, self.value = Events.allocate(capacity, columns)

    @property
    def capacity(self) -> int:
        """Number of events that fit before the log must grow or drop."""
        return self.t.size

    @property
    def events(self) -> Events:
        """Views of the valid rows."""
        return Events(*(column[: self.n] for column in self._columns()))

    @property
    def has_variances(self) -> bool:
        """Whether any measurement has variances of its own."""
        return self.value.shape[1] > self.width

    def _columns(self) -> tuple[np.ndarray, ...]:
        return self.t, self.arrival, self.kind, self.channel, self.value

    def add(self, sensor: str, seconds: ArrayLike, values: ArrayLike, *, variance: ArrayLike | None = None) -> int:
        """Insert measurements of one sensor.

        Args:
            sensor: Name of the sensor in the model.
            seconds: Times of measurement, s, shape (N,) or one number; in any order.
            values: Values in the units of the sensor's rows, shape (N,) or (N, rows); NaN is missing.
            variance: Variances of the noise of each measurement, in the units squared, where the sensor reports them
                (as GNSS receivers do); broadcast to the shape of `values`. NaN leaves the tuned R.

        Returns:
            Number of events in the log.

        Raises:
            EventError: If the log has no model, a name or a shape does not fit, or a time is before the start.
        """
        return self._put(arrays.readings(self._named("add"), sensor, seconds, values, variance))

    def add_inputs(self, seconds: ArrayLike, **inputs: ArrayLike) -> int:
        """Insert inputs; each holds until its next value.

        Args:
            seconds: Times from which the values hold, s, shape (N,) or one number.
            **inputs: Values by name, in the inputs' units, shape (N,) or one number; NaN keeps the previous value.

        Returns:
            Number of events in the log.

        Raises:
            EventError: As `add`.
        """
        return self._put(arrays.inputs(self._named("add_inputs"), seconds, inputs))

    def add_truth(self, seconds: ArrayLike, **states: ArrayLike) -> int:
        """Insert true states, against which the estimate is scored. The filter never uses them.

        Args:
            seconds: Times of the values, s, shape (N,) or one number.
            **states: True values by name, in the states' units, shape (N,) or one number; NaN is unknown.

        Returns:
            Number of events in the log.

        Raises:
            EventError: As `add`.
        """
        return self._put(arrays.truth(self._named("add_truth"), seconds, states))

    def add_ticks(self, seconds: ArrayLike) -> int:
        """Insert queries at times `seconds`, shape (N,) or one number: each adds a row with the estimate to the track.

        Returns:
            Number of events in the log.

        Raises:
            EventError: If a time is not finite or before the start.
        """
        return self._put(arrays.ticks(self.width, seconds))

    def _named(self, method: str) -> StateSpaceModel:
        if self.model is None:
            raise EventError(f"{method}: this log has no model, so names are unknown; create it with Log.of(model)")
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
        """Insert a batch of events at their times.

        Args:
            batch: Events in any order. Value columns beyond `width` hold variances, see `Events`.
            horizon: Nanoseconds; an event older by more than this than the newest event that arrived before it is
                dropped as stale. The result does not depend on how arrivals were cut into batches. An event before
                `floor` is stale with any horizon.
            settled: Mask (N,) of events that arrived in time and were held by the clock guard; no horizon applies.

        Returns:
            The lowest index whose event changed (the old `n` if all were appended) and the number of dropped events.

        Raises:
            EventError: If an event does not fit; the log is then unchanged.
        """
        # Broadcasting would repeat a single column, and give a true value to other states.
        batch = admitted(batch, self.width, self.layout).widened(self.width)
        if not len(batch):
            return self.n, 0
        newest, late = self.lateness(batch, horizon, settled)
        self.newest = int(newest[-1])
        stale = int(np.count_nonzero(late))
        if stale:
            batch = batch.select(~late)
            if not len(batch):
                return self.n, stale
        if not in_order(batch):
            batch = batch.select(sorted_order(batch))
        self._reserve(len(batch), batch.value.shape[1])
        batch = batch.widened(self.value.shape[1])
        self.changes += 1
        return self._insert(batch), stale

    def lateness(
        self, batch: Events, horizon: int | None, settled: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the newest time when each event of a batch (N,) arrives, ns, and a mask of the stale: see `extend`."""
        # Ticks and marks carry no data of the asset, so no event is late relative to them.
        times = np.where((batch.kind == TICK) | (batch.kind == MARK), self.newest, batch.t)
        newest = np.maximum(np.maximum.accumulate(times), self.newest)
        oldest = np.full(len(batch), self.floor)
        if horizon is not None:
            oldest = np.maximum(newest - horizon, oldest)
        if settled is not None:
            oldest[settled] = self.floor
        return newest, batch.t < oldest

    def _insert(self, batch: Events) -> int:
        """Merge an ordered batch and return the lowest index that changed."""
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
        """Make room for `extra` more events, and for variances if these are the first with any."""
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
        self.value[: self.n, wide:] = np.nan

    def drop_front(self, count: int) -> None:
        """Drop the oldest `count` events; events before the last of these are stale from now on."""
        if count:
            self.floor = max(self.floor, int(self.t[count - 1]))
            self.version += versions_dropped(self.events, count)
        for column in self._columns():
            column[: self.n - count] = column[count : self.n].copy()
        self.n -= count
        self.first += count

    def copy(self) -> Log:
        """Return an independent log with the same events."""
        twin = Log(self.width, 1)
        twin.__dict__.update(self.__dict__)
        twin._allocate(max(1, self.n), self.value.shape[1])
        for new, old in zip(twin._columns(), self._columns(), strict=True):
            new[: self.n] = old[: self.n]
        return twin


_ORDER = (INPUT, READING, TRUTH, TICK, MARK, MAINTENANCE, RESET)
_RANK = np.array([_ORDER.index(kind) for kind in range(len(_ORDER))], np.int64) << 32


def in_order(events: Events) -> bool:
    """Return whether events are strictly in order, without a pair that only their values could order."""
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


def model_version_at(log: Log, t: int) -> int:
    """Return the version of the model at time t, ns."""
    times = np.unique(log.events.t[log.events.kind == MAINTENANCE])
    return log.version + int(np.searchsorted(times, t, side="right"))
