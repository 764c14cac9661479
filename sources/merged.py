"""Several recordings of one asset, merged in order of time; events from rows and from memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from estimators.errors import SourceError
from estimators.events.batch import COLUMN_TYPES
from estimators.log import Events

from .source import Recorded, Source, is_endless, span_of


class Merged(Source):
    """Merges sources that are not live; events of equal time keep the order in which the sources are given.

    A source whose own events step back in time (a late reading, as recorded) keeps its order: such an event comes
    with the one that came before it.
    """

    live = False

    def __init__(self, sources: Sequence[Source]) -> None:
        if not sources:
            raise SourceError("merged: parts is empty; name at least one recording")
        if any(source.live for source in sources):
            raise SourceError("merged: a live source cannot be merged with others; use recordings")
        self._sources: list[Source] = list(sources)
        self._pending: list[Events | None] = [None] * len(self._sources)
        self._order: list[np.ndarray] = [np.zeros(0, np.int64)] * len(self._sources)
        self._latest = [np.iinfo(np.int64).min] * len(self._sources)
        self._ended = [False] * len(self._sources)

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time of all, ns; None if one is not known."""
        spans = [span_of(source) for source in self._sources]
        known = [span for span in spans if span is not None]
        if len(known) < len(spans):
            return None
        return min(span[0] for span in known), max(span[1] for span in known)

    @property
    def endless(self) -> bool:
        """Whether one of them has no end."""
        return any(map(is_endless, self._sources))

    def read(self, timeout: float) -> Events | None:
        """Return the next events of all sources, up to the earliest time to which every one of them is known."""
        for k, source in enumerate(self._sources):
            while not self._ended[k] and not self._order[k].size:
                batch = source.read(timeout)
                if batch is None:
                    self._ended[k] = True
                elif len(batch):
                    order = np.maximum(np.maximum.accumulate(batch.t), self._latest[k])
                    self._pending[k], self._order[k], self._latest[k] = batch, order, int(order[-1])
                else:
                    return batch  # It has more, but not yet; until then the others' order is not known.
        waiting = [k for k in range(len(self._sources)) if self._order[k].size]
        if not waiting:
            return None
        # What ended sets no limit. At the limit itself a source may still have more events: those of the sources behind
        # it wait for them, so that events of equal time come in the order of the sources.
        running = [k for k in waiting if not self._ended[k]]
        limit, holder = min(((int(self._order[k][-1]), k) for k in running), default=(None, len(self._sources)))
        parts, orders = [], []
        for k in waiting:
            pending = self._pending[k]
            assert pending is not None
            side: Literal["left", "right"] = "right" if k <= holder else "left"
            count = self._order[k].size if limit is None else int(np.searchsorted(self._order[k], limit, side=side))
            parts.append(pending.select(slice(0, count)))
            orders.append(self._order[k][:count])
            self._pending[k], self._order[k] = pending.select(slice(count, None)), self._order[k][count:]
        joined = Events.concat(parts, 0)
        return joined.select(np.argsort(np.concatenate(orders), kind="stable"))

    def close(self) -> None:
        """Close them all."""
        for source in self._sources:
            source.close()


def batch_of(rows: Sequence[tuple[int, int, int, int, np.ndarray]], width: int) -> Events:
    """Return rows (t, arrival, kind, channel, values) as events with at least `width` value columns."""
    if not rows:
        return Events.empty(width)
    *columns, values = zip(*rows, strict=True)
    value = np.full((len(rows), max(width, *(given.size for given in values))), np.nan)
    for row, given in zip(value, values, strict=True):
        row[: given.size] = given
    kinds = zip(columns, COLUMN_TYPES.values(), strict=True)
    return Events._make([*(np.array(column, kind) for column, kind in kinds), value])


BATCH = 4096


class MemorySource(Recorded):
    """Returns `readings` in their order, some thousands at a time."""

    def __init__(self, readings: Events, *, batch: int = BATCH) -> None:
        self._readings = readings
        self._batches = (readings.select(slice(k, k + batch)) for k in range(0, len(readings), batch))

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time, ns."""
        t = self._readings.t
        return (int(t.min()), int(t.max())) if t.size else None
