"""The rows of the track that the charts and the scene still need, kept in arrays of the view's own."""

from __future__ import annotations

from typing import Any

import numpy as np

_COLUMNS = ("t", "kind", "channel", "value", "mean", "std", "nis", "nis_mean", "nis_low", "nis_high", "verdict")


class History:
    """A sliding copy of the track: the last `span` nanoseconds, and never more than `limit` rows.

    Row i of the arrays is event `base + i` of the log. Rows that a late reading or another revision rewrites are
    simply pulled again, and overwrite what is here from there on.
    """

    def __init__(self, nx: int, width: int, limit: int = 200_000) -> None:
        self.limit = limit
        self.span: int | None = None
        self.base = 0
        self.n = 0
        self.origin: int | None = None
        """Time of the first event ever seen, from which the charts count seconds."""
        shapes = {"value": (width,), "mean": (nx,), "std": (nx,)}
        kinds = {"t": np.int64, "kind": np.int8, "channel": np.int32, "verdict": np.int8}
        self._columns = {
            name: np.zeros((4096, *shapes.get(name, ())), kinds.get(name, np.float64)) for name in _COLUMNS
        }

    def column(self, name: str) -> np.ndarray:
        """The valid rows of one column, as a view."""
        return self._columns[name][: self.n]

    def settled(self, name: str, rows: int) -> np.ndarray:
        """The newest rows of a column, only the last one of each time: what all sensors together made of it."""
        t = self.column("t")[-4 * rows :]
        last = np.append(t[1:] != t[:-1], [True] * bool(t.size))
        return self.column(name)[-4 * rows :][last.astype(bool)][-rows:]

    def clear(self) -> None:
        """Forget all rows; the origin of time stays."""
        self.base, self.n = 0, 0

    def take(self, pull: Any) -> int:
        """Write a pull into the arrays.

        Returns:
            The first row that changed; all after it did too.
        """
        count = len(pull.readings)
        if pull.fresh or not self.n or not self.base <= pull.first <= self.base + self.n:
            self.base, self.n = pull.first, 0
        if not count:
            return self.n
        if pull.first == 0 or self.origin is None:
            self.origin = int(pull.readings.t[0])
        start = pull.first - self.base
        self._reserve(start + count)
        for name, column in self._columns.items():
            batch = getattr(pull.readings if name in ("t", "kind", "channel", "value") else pull.track, name)
            column[start : start + count] = batch
        self.n = start + count
        return start

    def trim(self) -> int:
        """Drop what is older than the span, once that is a third of what is here.

        Returns:
            How many rows went, by which all row numbers fall.
        """
        drop = max(0, self.n - self.limit)
        if self.span is not None and self.n:
            drop = max(drop, int(np.searchsorted(self.column("t"), self._columns["t"][self.n - 1] - self.span)))
        if drop * 3 < self.n and self.n <= self.limit:
            return 0
        for column in self._columns.values():
            column[: self.n - drop] = column[drop : self.n].copy()
        self.base += drop
        self.n -= drop
        return drop

    def _reserve(self, rows: int) -> None:
        capacity = self._columns["t"].shape[0]
        if rows <= capacity:
            return
        capacity = max(rows, 2 * capacity)
        for name, column in self._columns.items():
            wider = np.zeros((capacity, *column.shape[1:]), column.dtype)
            wider[: self.n] = column[: self.n]
            self._columns[name] = wider
