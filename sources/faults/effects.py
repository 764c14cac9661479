"""Effects of faults on single events: on values, on times, and on delivery; and a fault with its time window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from estimators.log import INPUT, MARK, READING, Events
from estimators.model.state_space import StateSpaceModel

from ..merged import batch_of
from .kinds import Fault, find_kind, numbers


def ns(seconds: float) -> int:
    """Return seconds as whole nanoseconds."""
    return round(seconds * 1e9)


@dataclass(slots=True)
class FaultedEvent:
    """An event. `at` is its true time of measurement, ns, whatever the stamp `t`; `value` is never written to."""

    t: int
    arrival: int
    kind: int
    channel: int
    value: np.ndarray
    at: int

    def with_cells(self, cells: slice, values: np.ndarray) -> FaultedEvent:
        """Return a copy with other values in some columns."""
        value = self.value.copy()
        value[cells] = values
        return replace(self, value=value)

    def alone(self, kind: int, channel: int, column: int, value: float) -> FaultedEvent:
        """Return another event of this true time with one value."""
        values = np.full_like(self.value, np.nan)
        values[column] = value
        return FaultedEvent(self.at, self.arrival, kind, channel, values, self.at)


def items_of(events: Events) -> list[FaultedEvent]:
    """Return the events of a batch, one by one."""
    columns = (events.t.tolist(), events.arrival.tolist(), events.kind.tolist(), events.channel.tolist())
    return [FaultedEvent(*row, row[0]) for row in zip(*columns, events.value, strict=True)]


def events_of(items: Sequence[FaultedEvent], width: int) -> Events:
    """Return events as a batch of at least `width` value columns."""
    return batch_of([(item.t, item.arrival, item.kind, item.channel, item.value) for item in items], width)


class Target:
    """Events and values that a fault affects. `channel` is its number in the log's marks: sensors, inputs, all."""

    def __init__(self, fault: Fault, model: StateSpaceModel) -> None:
        self._rows = [len(sensor.rows) for sensor in model.sensors]
        self._nu = len(model.inputs)
        self._kinds: tuple[int, ...] = ()
        self.sensors: tuple[int, ...] = ()
        self.input: int | None = None
        self._row: int | None = None
        self.channel = len(self._rows) + self._nu
        if fault.sensor is not None:
            self.channel = model.sensor_names.index(fault.sensor)
            self.sensors = (self.channel,)
            if fault.other is not None:
                self.sensors += (model.sensor_names.index(fault.other),)
            if fault.row is not None:
                self._row = [row.name for row in model.sensors[self.channel].rows].index(fault.row)
        elif fault.input is not None:
            self.input = model.input_names.index(fault.input)
            self.channel = len(self._rows) + self.input
        elif fault.parameter is None:
            # Of the whole twin, a stuck fault affects the sensors only.
            self._kinds = (READING,) if fault.kind == "stuck" else (READING, INPUT)

    def has(self, item: FaultedEvent) -> bool:
        """Return whether an event is affected; one that leaves an input unchanged is not."""
        if self._kinds:
            return item.kind in self._kinds
        if self.input is not None:
            return item.kind == INPUT and not np.isnan(item.value[self.input])
        return item.kind == READING and item.channel in self.sensors

    def cells(self, item: FaultedEvent) -> slice:
        """Return the affected columns of an event's values, all rows of a sensor."""
        if self.input is not None:
            return slice(self.input, self.input + 1)
        return slice(0, self._rows[item.channel] if item.kind == READING else self._nu)

    def touched(self, size: int) -> np.ndarray:
        """Return which of `size` rows are affected, shape (size,)."""
        return np.ones(size, bool) if self._row is None else np.arange(size) == self._row

    def split(self, item: FaultedEvent) -> tuple[list[FaultedEvent], FaultedEvent]:
        """Return the unaffected part of an event (other inputs), if there is one, and the affected part."""
        if self.input is None:
            return [], item
        own = np.arange(item.value.size) == self.input
        mine, rest = (replace(item, value=np.where(cells, item.value, np.nan)) for cells in (own, ~own))
        return [] if np.isnan(rest.value).all() else [rest], mine


@dataclass(frozen=True)
class Moment:
    """State of the fault at an event: whether it is active, whether it draws, and ns since it began."""

    during: bool
    draws: bool
    since: int


class Effect:
    """Effect of a fault on the events of its target, in their order of arrival; by default none.

    `lost` counts removed events. `last` is the last value of the target, if that is an input. `_kept` is what some
    effects keep of earlier events, by kind and channel.
    """

    def __init__(self, kind: str, target: Target, given: dict[str, float], rng: np.random.Generator) -> None:
        self._kind, self._target, self._given, self._rng = kind, target, given, rng
        self.lost = 0
        self.last: float | None = None
        self._kept: dict = {}

    def apply(self, item: FaultedEvent, moment: Moment) -> list[FaultedEvent]:
        """Return the events in place of one event."""
        return [item]

    def turn(self, item: FaultedEvent, moment: Moment) -> list[FaultedEvent]:
        """Return the events to insert before the event with which the fault begins or ends."""
        return []

    def flush(self) -> list[FaultedEvent]:
        """Return the events that are still held back at the end."""
        return []

    def _hit(self, moment: Moment) -> bool:
        """Draw whether the fault affects an event."""
        return moment.draws and bool(self._rng.random() < self._given.get("rate", 1.0))

    def _last_input(self, item: FaultedEvent) -> list[FaultedEvent]:
        """Return the last value of the target, an input that may not change for long, as an event."""
        if self._target.input is None or self.last is None:
            return []
        return [item.alone(INPUT, 0, self._target.input, self.last)]


class Silence(Effect):
    """Removes the events of its target; an input keeps its last value, which is repeated at the end of the fault."""

    def apply(self, item: FaultedEvent, moment: Moment) -> list[FaultedEvent]:
        """Return the part of the event that is not affected."""
        self.lost += moment.during
        return self._target.split(item)[0] if moment.during else [item]

    def turn(self, item: FaultedEvent, moment: Moment) -> list[FaultedEvent]:
        """Return the last value of an input at the end."""
        return [] if moment.during else self._last_input(item)


class Swap(Effect):
    """Exchanges the measurements of two sensors."""

    def apply(self, item: FaultedEvent, moment: Moment) -> list[FaultedEvent]:
        """Return the measurement under the other sensor's name."""
        return [replace(item, channel=sum(self._target.sensors) - item.channel)] if moment.during else [item]


class ValueEffect(Effect):
    """Changes the values of its target.

    For every event of the target it draws a number and then one for each row, whatever the kind: so the draws of a
    scheduled fault do not depend on its end, and a fault on one row leaves those of the others.
    """

    def apply(self, item: FaultedEvent, moment: Moment) -> list[FaultedEvent]:
        """Return the event with changed values."""
        cells = self._target.cells(item)
        y = item.value[cells]
        hit = self._hit(moment)
        draw = self._rng.standard_normal(y.size) if moment.draws else np.zeros(y.size)
        held = self._kept.get((item.kind, item.channel))
        if not moment.during or held is None:
            held = y if held is None else np.where(np.isnan(y), held, y)
            self._kept[item.kind, item.channel] = held
        if not moment.during:
            return [item]
        changed = self._changed(y, held, moment.since / 1e9, hit, draw)
        return [item.with_cells(cells, np.where(self._target.touched(y.size), changed, y))]

    def _changed(self, y: np.ndarray, held: np.ndarray, seconds: float, hit: bool, draw: np.ndarray) -> np.ndarray:
        """Return the changed values of y (ny,); `held` are those before the start, `draw` is N(0, 1), both (ny,)."""
        size = self._given.get("size", 0.0)
        match self._kind:
            case "bias":
                return y + size
            case "drift":
                return y + size * seconds
            case "scale":
                return y * size
            case "stuck":
                return np.where(np.isnan(y), y, held)  # Lost values stay lost.
            case "noise":
                return y + size * draw
            case "quantisation":
                return np.round(y / size) * size
            case "spike" if hit:
                return y + size * draw
            case "dropout" if hit:
                return np.full(y.size, np.nan)
        return y

    def turn(self, item: FaultedEvent, moment: Moment) -> list[FaultedEvent]:
        """Return an input's value at the start and end, since it holds until it changes."""
        calm = replace(moment, draws=False)
        return [changed for event in self._last_input(item) for changed in self.apply(event, calm)]


class TimeEffect(Effect):
    """Shifts the times of its target's events. A delayed one is delivered at its new time of arrival."""

    def apply(self, item: FaultedEvent, moment: Moment) -> list[FaultedEvent]:
        """Return the event with shifted times, and its repetitions."""
        hit = self._hit(moment)
        draw = float(self._rng.standard_exponential()) if moment.draws else 0.0
        if not moment.during:
            return [item]
        rest, mine = self._target.split(item)
        shifts = self._shifts(mine, moment, hit, draw)
        return [*rest, *(replace(mine, t=mine.t + stamp, arrival=mine.arrival + late) for stamp, late in shifts)]

    def _shifts(self, item: FaultedEvent, moment: Moment, hit: bool, draw: float) -> list[tuple[int, int]]:
        """Return for each event in place of one the ns added to its stamp and to its arrival."""
        size, every = self._given.get("size", 0.0), self._given.get("every", 0.0)
        match self._kind:
            case "delay":
                return [(0, ns(size))]
            case "jitter":
                return [(0, ns(size * draw))]
            case "bursts":
                since = moment.since + item.arrival - item.at  # A late event arrives later than it was measured.
                return [(0, max(1, ceil(since / ns(every))) * ns(every) - since)]
            case "duplicate":
                count = round(self._given["count"]) if hit else 0
                return [(ns(k * every), ns(k * every)) for k in range(count + 1)]
            case "clock_jump":
                return [(ns(size), 0)]
        return [(ns(size * (moment.since / 1e9)), 0)]  # clock_drift


class Reorder(Effect):
    """Holds an event back until the next one of its kind and channel, and delivers it after that."""

    def apply(self, item: FaultedEvent, moment: Moment) -> list[FaultedEvent]:
        """Return nothing, the event, or the event and the one before it."""
        hit = self._hit(moment)
        rest, mine = self._target.split(item)
        key = (mine.kind, mine.channel)
        before = self._kept.pop(key, None)
        if before is not None:
            return [*rest, mine, replace(before, arrival=max(before.arrival, mine.arrival))]
        if hit and moment.during:
            self._kept[key] = mine
            return rest
        return [item]

    def flush(self) -> list[FaultedEvent]:
        """Return the events without a next one."""
        kept, self._kept = list(self._kept.values()), {}
        return kept


_VALUES = ("bias", "drift", "scale", "stuck", "spike", "noise", "quantisation", "dropout")
_TIMES = ("delay", "jitter", "bursts", "duplicate", "clock_jump", "clock_drift")
EFFECTS: dict[str, type[Effect]] = {
    **dict.fromkeys(_VALUES, ValueEffect),
    **dict.fromkeys(_TIMES, TimeEffect),
    "reorder": Reorder,
    "silence": Silence,
    "swap": Swap,
    "model": Effect,  # The asset itself changes; its events pass unchanged.
}
"""Effect of each kind of fault."""


class ActiveFault:
    """One fault from `start` until `end`, ns, of the true time of measurement.

    A `scheduled` fault draws from the first event on, so that its draws do not depend on its start; an injected one
    from its start on, as it has not seen earlier events. So both draw the same numbers when the source begins again.
    `inputs` are the last inputs before it was injected.
    """

    def __init__(
        self,
        fault: Fault,
        model: StateSpaceModel,
        seed: tuple[int, int],
        start: int,
        end: int,
        *,
        scheduled: bool,
        inputs: np.ndarray,
    ) -> None:
        self.start, self.end = start, end
        self.begun = self.ended = False
        self.touched = 0
        self.since: int | None = None
        self._target = Target(fault, model)
        kind = find_kind(fault.kind)
        self._code = kind.code
        self._scheduled = scheduled
        rng = np.random.default_rng(seed if fault.seed is None else fault.seed)
        self._effect = EFFECTS[kind.name](kind.name, self._target, numbers(fault), rng)
        index = self._target.input
        if index is not None and not np.isnan(inputs[index]):
            self._effect.last = float(inputs[index])

    @property
    def lost(self) -> int:
        """Events that it removed."""
        return self._effect.lost

    def process(self, items: list[FaultedEvent]) -> list[FaultedEvent]:
        """Return the events in place of these, in order, with marks at its start and end."""
        out: list[FaultedEvent] = []
        for item in items:
            # A mark is not an event of the asset, and has the time of the event beside it.
            if item.kind == MARK:
                out.append(item)
                continue
            if not self.begun and item.at >= self.start:
                self.begun, self.since = True, item.at
                out += self._edge(item, True)
            if self.begun and not self.ended and item.at >= self.end:
                self.ended = True
                out += self._edge(item, False)
            if not self._target.has(item):
                out.append(item)
                continue
            if self._target.input is not None:
                self._effect.last = float(item.value[self._target.input])
            moment = self._moment(item, self.start <= item.at < self.end)
            self.touched += moment.during
            out += self._effect.apply(item, moment)
        return out

    def flush(self) -> list[FaultedEvent]:
        """Return the events that it still holds back at the end."""
        return self._effect.flush()

    def _edge(self, item: FaultedEvent, during: bool) -> list[FaultedEvent]:
        """Return the mark of its start or end, and the events that its effect inserts there."""
        mark = item.alone(MARK, self._target.channel, 0, self._code if during else -self._code)
        return [mark, *self._effect.turn(item, self._moment(item, during))]

    def _moment(self, item: FaultedEvent, during: bool) -> Moment:
        return Moment(during, self._scheduled or item.at >= self.start, item.at - self.start)
