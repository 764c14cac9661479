"""The rows of the track that the scene and the chart still need, kept in arrays of the view's own."""

from __future__ import annotations

import numpy as np

from estimators.log import Events

from ...live.outputs import Pull

_EVENTS = ("t", "kind", "channel", "value")
_COLUMNS = (*_EVENTS, "mean", "std", "nis", "nis_mean", "nis_low", "nis_high", "verdict")


class History:
    """A sliding copy of the track: the last `span` nanoseconds, and never more than `2 * limit` rows.

    Row i of the arrays is event `base + i` of the log. Rows that a late reading or another revision rewrites are
    simply pulled again, and overwrite what is here from there on.
    """

    def __init__(self, nx: int, width: int, limit: int = 32_768) -> None:
        self.limit = limit
        self.span: int | None = None
        self.base = 0
        self.n = 0
        shapes = {"value": (width,), "mean": (nx,), "std": (nx,)}
        kinds = {"t": np.int64, "kind": np.int8, "channel": np.int32, "verdict": np.int8}
        # Filled, not empty: the pages are paid for now, and memory stays flat.
        self._columns = {
            name: np.full((2 * limit, *shapes.get(name, ())), 0, kinds.get(name, np.float64)) for name in _COLUMNS
        }

    def column(self, name: str) -> np.ndarray:
        """The valid rows of one column, as a view."""
        return self._columns[name][: self.n]

    def events(self, rows: slice = slice(None)) -> Events:
        """Some of the valid rows as events, as views; each as if it had arrived when it was measured."""
        t, kind, channel, value = (self.column(name)[rows] for name in ("t", "kind", "channel", "value"))
        return Events(t, t, kind, channel, value)

    def settled(self, name: str, rows: int) -> np.ndarray:
        """The newest rows of a column, only the last one of each time: what all sensors together made of it."""
        t = self.column("t")[-4 * rows :]
        last = np.append(t[1:] != t[:-1], [True] * bool(t.size))
        return self.column(name)[-4 * rows :][last.astype(bool)][-rows:]

    def clear(self) -> None:
        """Forget all rows."""
        self.base, self.n = 0, 0

    def take(self, pull: Pull) -> int:
        """Write a pull of at most `limit` rows into the arrays.

        Returns:
            The first row that changed; all after it did too.
        """
        count = len(pull.events)
        if pull.fresh or not self.n or not self.base <= pull.first <= self.base + self.n:
            self.base, self.n = pull.first, 0
        if not count:
            return self.n
        start = pull.first - self.base
        if start + count > 2 * self.limit:
            start -= self._drop(start - self.limit)
        for name, column in self._columns.items():
            batch = getattr(pull.events if name in _EVENTS else pull.track, name)
            # Pictures have no use for the variances that readings bring, in columns after the values.
            column[start : start + count] = batch[:, : column.shape[1]] if column.ndim > 1 else batch
        self.n = start + count
        return start

    def trim(self) -> int:
        """Drop what is older than the span, once that is a third of what is here.

        Returns:
            How many rows went, by which all row numbers fall.
        """
        if self.span is None or not self.n:
            return 0
        drop = int(np.searchsorted(self.column("t"), self._columns["t"][self.n - 1] - self.span))
        return self._drop(drop) if drop * 3 >= self.n else 0

    def _drop(self, rows: int) -> int:
        for column in self._columns.values():
            column[: self.n - rows] = column[rows : self.n].copy()
        self.base += rows
        self.n -= rows
        return rows
