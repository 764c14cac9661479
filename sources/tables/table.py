"""Source of tables (CSV, Parquet, MATLAB, NumPy); each row holds the values of one time."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from estimators.errors import SourceError, nearest
from estimators.log import Events

from ..formats import check_present, suffix_of
from ..mapping import ABSENT, PRESENT, ChannelMapping
from ..source import NEVER, TRUNCATED, UNASSIGNED, Channel, Recorded, Report, ignore
from ..units import heading_unit
from .dialect import DETECTED, Dialect
from .order import Order
from .rows import TableRows, names_of, remarks_of, rows_of
from .text import READ_AS, TextMatch, column_of, has_rows
from .times import SERIAL_DAYS, UNITS, TimeColumn

BATCH_EVENTS = 4096  # Events that are returned at once


class Table(Recorded):
    """Reads tables of the same columns one after the other, as one recording.

    A row gives an event for its inputs, then its readings, then its true values. An empty cell (null in Parquet) is
    ignored: a row without any cell of a sensor is no measurement of it. NaN, or text that is not a number, is a
    missing value.

    Args:
        files: Tables in their order.
        time: The column that holds the time.
        channels: What feeds the model.
        width: Value columns of an event.
        report: Called for rows without a time and values that are not numbers, with file and line; and once of rows
            that were sorted, and of times that run backwards or stand still.
        horizon: Seconds by which a row may be older than one before it without being sorted; None for any.
        dialect: How CSV files are written, as far as it is not detected.

    Raises:
        SourceError: If a file or column is missing, or a unit does not convert.
    """

    def __init__(
        self,
        files: Sequence[str | os.PathLike[str]],
        *,
        time: TimeColumn,
        channels: Iterable[Channel],
        width: int,
        report: Report = ignore,
        horizon: float | None = None,
        dialect: Dialect = DETECTED,
    ) -> None:
        self._files = [Path(file) for file in files]
        if not self._files:
            raise SourceError("table: files is empty; name at least one recording")
        units = [*UNITS, *SERIAL_DAYS]
        if time.unit not in units:
            raise SourceError(f"table: the time unit is {time.unit!r}; choose from {', '.join(units)}")
        channels = list(channels)
        self._time, self._width, self._report, self._dialect = time, width, report, dialect
        self._shift = round(time.shift * 1e9)
        self._columns, self._mapping = mapped(channels, width, report)
        for path in self._files:
            _check(path, [*time.names, *map(column_of, self._columns)], dialect)
        for text in remarks_of(self._files, dialect):
            report(READ_AS, text)
        self._channels = channels
        self._selectors = _selectors(channels, self._columns)
        self._valued: set[str | TextMatch] = set()
        self._count = 0
        self._order = Order(time.label, time.unit, None if horizon is None else round(horizon * 1e9), report)
        self._batches = self._all()

    def _all(self) -> Generator[Events, None, None]:
        read: list[Events] = []
        for path in self._files:
            for batch in self._one(path):
                read.append(batch)
                # Rows that come later may belong before these; meanwhile the reader may be stopped.
                yield Events.empty(self._width)
        events = self._order.arranged(Events.concat(read, self._width))
        for first in range(0, len(events), BATCH_EVENTS):
            yield events.select(slice(first, first + BATCH_EVENTS))
        if self._count:
            for name in self._columns:
                if name not in self._valued:
                    self._report(NEVER, self._never(name))

    def _one(self, path: Path) -> Generator[Events, None, None]:
        before = self._count
        try:
            for rows in rows_of(path, self._time, self._columns, lambda: self._timeout, self._dialect):
                first = self._count == before
                batch = Events.empty(self._width) if rows is None else self._events(path, rows, first)
                yield batch
        except SourceError as error:
            if self._count == before:
                raise
            gist = str(error).removeprefix(f"{path}: ")
            self._report(TRUNCATED, f"{path.name}: damaged after {self._count - before} rows: {gist}")

    def _events(self, path: Path, rows: TableRows, first: bool) -> Events:
        """Return the events of the next rows of a file, or of its first ones."""
        for key, line, text in rows.problems:
            self._report(key, f"{path.name}:{line}: {text}")
        known = rows.known
        t, used = rows.t + self._shift, known.copy()
        if first:
            wrong = self._order.first(path.name, rows.line[known], t[known])
            used[np.flatnonzero(known)[:wrong]] = False
        self._count += rows.t.size
        if len(self._valued) < len(self._columns):
            matched = np.array([isinstance(name, TextMatch) for name in self._columns], np.bool_)
            valued = np.any(np.where(matched, rows.values == 1.0, np.isfinite(rows.values)), axis=0)
            self._valued.update(self._columns[k] for k in np.flatnonzero(valued))
        self._order.check(path.name, rows.line[used], t[used])
        for name, (keys, values) in self._selectors.items():
            named, valued = (np.any(np.isfinite(rows.values[:, k]) & ~rows.blank[:, k], axis=1) for k in (keys, values))
            for line in rows.line[used & valued & ~named]:
                text = f"{name} has no value, so the row is of no sensor and is left out; give it its {name}"
                self._report(UNASSIGNED, f"{path.name}:{line}: {text}")
        state = np.where(rows.blank, ABSENT, PRESENT).astype(np.int8)
        plan = np.zeros(t.size, np.int64)
        return self._mapping.events(plan, t, t, rows.values, state, (~used).astype(np.int8))[0]

    def _never(self, name: str | TextMatch) -> str:
        fed = ", ".join(channel.name for channel in self._channels if name in channel.needed)
        files = self._files[0].name + (f" and {len(self._files) - 1} more" if len(self._files) > 1 else "")
        if isinstance(name, TextMatch):
            wanted = " or ".join(map(repr, name.texts))
            return f"{files}: column {name.column!r} is never {wanted} in {self._count} rows, so {fed} has no values"
        return f"{files}: column {name!r} has no value in {self._count} rows, so {fed} has no values"

    def as_recorded(self) -> Iterator[Events]:
        """Yield the events of all rows as they were recorded, in place of `read`."""
        return (batch for path in self._files for batch in self._one(path))


def mapped(channels: Sequence[Channel], width: int, report: Report) -> tuple[list[str | TextMatch], ChannelMapping]:
    """Return the columns that feed channels, and what makes events of their values."""
    columns = list(dict.fromkeys(name for channel in channels for name in channel.needed))
    return columns, ChannelMapping([(channels, columns, [*map(heading_unit, columns)])], width=width, report=report)


def _selectors(
    channels: Sequence[Channel], columns: Sequence[str | TextMatch]
) -> dict[str, tuple[list[int], list[int]]]:
    """Return the places of each column that selects rows (`only`), and those of the values in these rows."""
    found: dict[str, tuple[list[int], list[int]]] = {}
    for channel in channels:
        for condition in channel.only:
            keys, values = found.setdefault(column_of(condition.signal), ([], []))
            keys.append(columns.index(condition.signal))
            values += [columns.index(name) for name in channel.signals]
    return found


def _check(path: Path, wanted: Sequence[str], dialect: Dialect) -> None:
    """Refuse a file that lacks a column, or rows, or that is no table at all.

    Raises:
        SourceError: Naming the file, the column and those that are near.
    """
    check_present(path)
    names = names_of(path, "", dialect)
    found = Counter(names)
    for name in wanted:
        if name not in found:
            raise SourceError(f"{path}: there is no column {name!r}; {nearest(name, names)}")
        if found[name] > 1:
            at = [k for k, other in enumerate(names, start=1) if other == name]
            places = " and ".join(f"the {_ordinal(k)}" for k in at[:2])
            raise SourceError(f"{path}: there are {len(at)} columns {name!r}, {places}; give each its own name")
    if suffix_of(path) == ".csv" and not has_rows(path, dialect):
        raise SourceError(f"{path}: it has a header and no rows; record it again")


def _ordinal(k: int) -> str:
    return f"{k}{'th' if k % 100 in (11, 12, 13) else {1: 'st', 2: 'nd', 3: 'rd'}.get(k % 10, 'th')}"
