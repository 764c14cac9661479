"""Values to events: units, conditions and kinds, the same for frames of a bus and rows of a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estimators.errors import SourceError
from estimators.log import INPUT, READING, TRUTH, Events
from estimators.numerics.jit import jit

from .geodesy import east_north
from .source import Channel, Report
from .units import conversion

PRESENT, ABSENT, SHORT = range(3)
"""A value is there; the frame does not carry the signal (multiplexing); the frame ends before it."""


class _Tables(NamedTuple):
    """Channels of all groups (messages, or one table), one a row; see `Mapping`."""

    group: np.ndarray
    kind: np.ndarray
    target: np.ndarray
    row: np.ndarray
    slot: np.ndarray
    factor: np.ndarray
    shift: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    where: np.ndarray
    where_slot: np.ndarray
    selects: np.ndarray
    low: np.ndarray
    high: np.ndarray


@jit
def _emit(tables, plan, skip, values, state, source, kind, channel, value, refused, cut):
    """Write the events of each frame: its inputs as one event, then readings, then true states in blocks.

    Returns how many. A block begins with a state that is known, and takes what follows as far as it reaches.
    """
    n = 0
    width = value.shape[1]
    for i in range(plan.size):
        g = plan[i]
        if g < 0 or skip[i] != 0:
            continue
        input_event = truth_event = -1
        for c in range(tables.group[g], tables.group[g + 1]):
            said = False
            for r in range(tables.row[c], tables.row[c + 1]):
                here = state[i, tables.slot[r]]
                said = said or here != ABSENT
                if here == SHORT:
                    cut[c] += 1
            if not said:
                continue
            good, meant = True, True
            for w in range(tables.where[c], tables.where[c + 1]):
                tested = values[i, tables.where_slot[w]]
                if state[i, tables.where_slot[w]] != PRESENT or not (tables.low[w] <= tested <= tables.high[w]):
                    good = False
                    meant = meant and tables.selects[w] == 0
            if not meant:
                continue
            if not good:
                refused[c] += 1
                if tables.kind[c] != READING:
                    continue
            if tables.kind[c] == INPUT and input_event >= 0:
                event = input_event
            elif tables.kind[c] == TRUTH and truth_event >= 0 and tables.target[c] < channel[truth_event] + width:
                event = truth_event
            else:
                event = n
                source[n] = i
                kind[n] = tables.kind[c]
                channel[n] = 0 if tables.kind[c] == INPUT else tables.target[c]
                for column in range(width):
                    value[n, column] = np.nan
                n += 1
                if tables.kind[c] == INPUT:
                    input_event = event
                elif tables.kind[c] == TRUTH:
                    truth_event = event
            if good:
                for r in range(tables.row[c], tables.row[c + 1]):
                    converted = tables.factor[r] * values[i, tables.slot[r]] + tables.shift[r]
                    column = r - tables.row[c]
                    if tables.kind[c] == INPUT:
                        column = tables.target[c]
                    elif tables.kind[c] == TRUTH:
                        column = tables.target[c] - channel[event]
                    final = tables.scale[r] * converted + tables.offset[r]
                    value[event, column] = final if np.isfinite(final) else np.nan
                if tables.kind[c] == TRUTH and np.isnan(value[event, 0]):
                    n -= 1
                    truth_event = -1
    return n


class Mapping:
    """Turns rows of values into events.

    Args:
        groups: For each message (or the one table): its channels, the names of its values in their order, and the
            unit that each value has where the channel declares none.
        width: Value columns of an event.
        report: Told of readings that a condition refused or that a short frame cut.

    Raises:
        SourceError: If a unit does not convert to the model's.
    """

    def __init__(
        self,
        groups: Sequence[tuple[Sequence[Channel], Sequence[str], Sequence[str | None]]],
        *,
        width: int,
        report: Report,
    ) -> None:
        self._width = width
        self._report = report
        order = (INPUT, READING, TRUTH)
        self._channels: list[Channel] = []
        group, kind, index, row, where = [0], [], [], [0], [0]
        slot, factors, scale, offset, where_slot, selects, low, high = ([] for _ in range(8))
        for channels, names, units in groups:
            positions = {name: k for k, name in enumerate(names)}
            # True states in their order, for the blocks.
            for channel in sorted(channels, key=lambda c: (order.index(c.kind), c.index if c.kind == TRUTH else 0)):
                self._channels.append(channel)
                kind.append(channel.kind)
                index.append(channel.index)
                for k, name in enumerate(channel.signals):
                    slot.append(positions[name])
                    unit = channel.units[k] or units[positions[name]]
                    factors.append(self._factor(channel, name, unit, channel.model_units[k]))
                    # Of a position, scale and offset hold for metres, not for degrees.
                    scale.append(1.0 if channel.convert else channel.scale[k])
                    offset.append(0.0 if channel.convert else channel.offset[k])
                row.append(len(slot))
                for condition in (*channel.where, *channel.only):
                    where_slot.append(positions[condition.signal])
                    selects.append(condition in channel.only)
                    low.append(condition.low)
                    high.append(condition.high)
                where.append(len(where_slot))
            group.append(len(self._channels))
        whole, real = np.int64, np.float64
        self._tables = _Tables(
            group=np.array(group, whole),
            kind=np.array(kind, whole),
            target=np.array(index, whole),
            row=np.array(row, whole),
            slot=np.array(slot, whole),
            factor=np.array([factor for factor, _ in factors], real),
            shift=np.array([shift for _, shift in factors], real),
            scale=np.array(scale, real),
            offset=np.array(offset, real),
            where=np.array(where, whole),
            where_slot=np.array(where_slot, whole),
            selects=np.array(selects, whole),
            low=np.array(low, real),
            high=np.array(high, real),
        )
        self._most = int(np.diff(self._tables.group).max(initial=0))
        # By sensor: a message that comes under two ids has its channels twice here.
        self._positions = {c.index: c for c in self._channels if c.convert == "east_north"}
        self._origins = {index: channel.origin for index, channel in self._positions.items()}
        empty, none = np.zeros(0, np.int64), np.zeros(0, np.int8)
        # Compiles now, not when the first event waits.
        self.events(empty, empty, empty, np.zeros((0, 1)), none.reshape(0, 1), none)

    @staticmethod
    def _factor(channel: Channel, name: str, unit: str | None, wanted: str) -> tuple[float, float]:
        if channel.convert == "east_north":
            return conversion(unit, "deg", f"{channel.name}: {name}")
        if channel.convert is not None:
            raise SourceError(f"{channel.name}: convert is {channel.convert!r}; only east_north is known")
        return conversion(unit, wanted, f"{channel.name}: {name}")

    def events(
        self,
        plan: np.ndarray,
        t: np.ndarray,
        arrival: np.ndarray,
        values: np.ndarray,
        state: np.ndarray,
        skip: np.ndarray,
    ) -> Events:
        """The events of rows of values.

        Args:
            plan: Group of each row, (n,); -1 has none.
            t: When each was measured, ns.
            arrival: When each arrived, ns.
            values: (n, most values of a group), NaN is missing.
            state: Same shape: PRESENT, ABSENT or SHORT.
            skip: (n,), not 0 where a row must be left out.
        """
        room = plan.size * self._most
        source = np.empty(room, np.int64)
        kind, channel = np.empty(room, np.int8), np.empty(room, np.int32)
        value = np.empty((room, self._width))
        refused, cut = np.zeros(len(self._channels), np.int64), np.zeros(len(self._channels), np.int64)
        n = _emit(self._tables, plan, skip, values, state, source, kind, channel, value, refused, cut)
        source = source[:n]
        batch = Events(t[source], arrival[source], kind[:n].copy(), channel[:n].copy(), value[:n].copy())
        if refused.any() or cut.any():
            self._tell(refused, cut)
        for item in self._positions.values():
            self._place(batch, item)
        return batch

    def _tell(self, refused: np.ndarray, cut: np.ndarray) -> None:
        for c in np.flatnonzero(refused):
            channel = self._channels[c]
            rule = " and ".join(f"{w.signal} in {w.low:g} to {w.high:g}" for w in channel.where)
            for _ in range(refused[c]):
                self._report(f"condition {channel.name}", f"{channel.name}: reading refused; it needs {rule}")
        for c in np.flatnonzero(cut):
            channel = self._channels[c]
            for _ in range(cut[c]):
                self._report(
                    f"short frame {channel.name}",
                    f"{channel.name}: a frame of {channel.message} ends before {', '.join(channel.signals)}",
                )

    def _place(self, batch: Events, channel: Channel) -> None:
        """Latitude and longitude to east and north, in place; the first valid fix is the origin unless one is given."""
        rows = np.flatnonzero((batch.kind == READING) & (batch.channel == channel.index))
        if not rows.size:
            return
        fixes = batch.value[rows, :2]
        if self._origins[channel.index] is None:
            valid = np.flatnonzero((np.abs(fixes[:, 0]) <= 90) & (np.abs(fixes[:, 1]) <= 180))
            if not valid.size:
                batch.value[rows, :2] = np.nan
                return
            first = fixes[valid[0]]
            self._origins[channel.index] = (float(first[0]), float(first[1]))
        origin = self._origins[channel.index]
        assert origin is not None
        metres = east_north(fixes, origin)
        for k in range(2):
            factor, shift = conversion("m", channel.model_units[k], channel.name)
            batch.value[rows, k] = channel.scale[k] * (factor * metres[:, k] + shift) + channel.offset[k]
