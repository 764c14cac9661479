"""One event by itself, as faults take and give it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimators.log import Events


class Item:
    """An event. `at` is when it was truly measured, ns, whatever the clocks say in `t`; `value` is never written to."""

    __slots__ = ("t", "arrival", "kind", "channel", "value", "at")

    def __init__(self, t: int, arrival: int, kind: int, channel: int, value: np.ndarray, at: int) -> None:
        self.t, self.arrival, self.kind, self.channel, self.value, self.at = t, arrival, kind, channel, value, at

    def but(
        self,
        *,
        t: int | None = None,
        arrival: int | None = None,
        channel: int | None = None,
        value: np.ndarray | None = None,
    ) -> Item:
        """The same event, with these in place of its own."""
        return Item(
            self.t if t is None else t,
            self.arrival if arrival is None else arrival,
            self.kind,
            self.channel if channel is None else channel,
            self.value if value is None else value,
            self.at,
        )

    def with_cells(self, cells: slice, values: np.ndarray) -> Item:
        """The same event with other values in some columns."""
        value = self.value.copy()
        value[cells] = values
        return self.but(value=value)


def items_of(events: Events) -> list[Item]:
    """The events of a batch, one by one."""
    columns = (events.t.tolist(), events.arrival.tolist(), events.kind.tolist(), events.channel.tolist())
    return [
        Item(t, arrival, kind, channel, value, t)
        for t, arrival, kind, channel, value in zip(*columns, events.value, strict=True)
    ]


def events_of(items: Sequence[Item], width: int) -> Events:
    """Events as a batch of at least `width` value columns."""
    if not items:
        return Events.empty(width)
    widest = max(width, *(item.value.size for item in items))
    value = np.full((len(items), widest), np.nan)
    for row, item in zip(value, items, strict=True):
        row[: item.value.size] = item.value
    return Events(
        np.array([item.t for item in items], np.int64),
        np.array([item.arrival for item in items], np.int64),
        np.array([item.kind for item in items], np.int8),
        np.array([item.channel for item in items], np.int32),
        value,
    )
