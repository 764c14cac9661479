"""Collects events one by one into a batch."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np

from estimators.log import Events


class Batch:
    """Events that grow one by one; `take` gives them as arrays and starts again."""

    def __init__(self, width: int) -> None:
        self.width = width
        self._blank = [np.nan] * width
        self._clear()

    def _clear(self) -> None:
        self._t: list[int] = []
        self._kind: list[int] = []
        self._channel: list[int] = []
        self._value: list[list[float]] = []

    def __len__(self) -> int:
        """Events so far."""
        return len(self._t)

    def add(self, t: int, kind: int, channel: int, values: Sequence[float] = ()) -> None:
        """One event; `values` fill the first columns, the rest is NaN."""
        self._t.append(t)
        self._kind.append(kind)
        self._channel.append(channel)
        row = self._blank.copy()
        row[: len(values)] = values
        self._value.append(row)

    def take(self) -> Events:
        """All events; a recording's arrive at the moment at which they were measured."""
        n = len(self._t)
        t = np.array(self._t, np.int64)
        value = np.fromiter(chain.from_iterable(self._value), np.float64, n * self.width).reshape(n, self.width)
        batch = Events(t, t.copy(), np.array(self._kind, np.int8), np.array(self._channel, np.int32), value)
        self._clear()
        return batch
