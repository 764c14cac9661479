"""Tables (CSV, Parquet, MATLAB, NumPy) as recordings: each row is what was known at one time."""

from __future__ import annotations

import os
from collections.abc import Generator, Iterable, Sequence
from pathlib import Path

import numpy as np

from estimators.errors import SourceError
from estimators.log import Readings

from ..can.signals import ABSENT, PRESENT
from ..mapping import Mapping
from ..source import Channel, Report, ignore
from .files import check_columns, read_table
from .order import Order
from .time_column import UNITS, column_ns


class Table:
    """Reads tables of the same columns one after the other, as one recording.

    A row gives an event for its inputs, then its readings, then its true values. An empty cell (null in Parquet) says
    nothing: a row without any cell of a sensor is no reading of it. NaN, or text that is no number, is a value that is
    missing.

    Args:
        files: Tables in their order.
        time_column: The column that tells the time: numbers in `time_unit`, or dates in ISO 8601 (UTC without a zone).
        time_unit: s, ms, us, ns, min or h.
        time_shift: Seconds added to it.
        channels: What feeds the model.
        width: Value columns of an event.
        report: Told of rows without a time and of values that are no numbers, with file and line; and once of times
            that run backwards or stand still.
        horizon: Seconds by which a row may be older than one before it; None for any.

    Raises:
        SourceError: If a file or column is missing, or a unit does not convert.
    """

    live = False

    def __init__(
        self,
        files: Sequence[str | os.PathLike[str]],
        *,
        time_column: str,
        time_unit: str,
        time_shift: float = 0.0,
        channels: Iterable[Channel],
        width: int,
        report: Report = ignore,
        horizon: float | None = None,
    ) -> None:
        self._files = [Path(file) for file in files]
        if not self._files:
            raise SourceError("table: files is empty; name at least one recording")
        if time_unit not in UNITS:
            raise SourceError(f"table: the time unit is {time_unit!r}; choose from {', '.join(UNITS)}")
        channels = list(channels)
        self._time, self._unit, self._width, self._report = time_column, time_unit, width, report
        self._shift = round(time_shift * 1e9)
        self._columns = list(dict.fromkeys(name for channel in channels for name in channel.needed))
        for path in self._files:
            check_columns(path, [time_column, *self._columns])
        self._mapping = Mapping([(channels, self._columns, [None] * len(self._columns))], width=width, report=report)
        self._order = Order(time_column, time_unit, None if horizon is None else round(horizon * 1e9), report)
        self._batches = self._all()

    def _all(self) -> Generator[Readings, None, None]:
        for path in self._files:

            def problem(key: str, line: int, text: str, path: Path = path) -> None:
                self._report(key, f"{path.name}:{line}: {text}")

            for chunk in read_table(path, self._time, self._columns, problem):
                t, known = column_ns(chunk.time, self._unit)
                for row in np.flatnonzero(~known):
                    self._report(
                        "undated row",
                        f"{path.name}:{chunk.line[row]}: {self._time} is no time, or one that needs another unit; "
                        "the row is left out",
                    )
                t = t + self._shift
                self._order.look(path.name, chunk.line[known], t[known])
                values = chunk.values
                state = np.where(chunk.blank, ABSENT, PRESENT).astype(np.int8)
                plan = np.zeros(t.size, np.int64)
                batch = self._mapping.events(plan, t, t, values, state, (~known).astype(np.int8))
                if len(batch):
                    yield batch

    def read(self, timeout: float) -> Readings | None:
        """The events of the next rows; None at the end."""
        return next(self._batches, None)

    def now(self) -> int | None:
        """A recording has no clock."""
        return None

    def close(self) -> None:
        """Close the file that is open."""
        self._batches.close()
