"""The rows of a table with their times, of any format.

Text is read in this process; other formats in a process of their own, since their libraries can crash.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estimators.errors import SourceError

from ..formats import suffix_of
from ..units import to_ns
from ..worker_process import IsolatedReader, read_isolated
from .binary import mat_names, npz_names, parquet_names, read_mat, read_npz, read_parquet
from .text import Chunk, Problem, csv_header, read_csv

UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1, "min": 60 * 10**9, "h": 3600 * 10**9}
"""Nanoseconds of each unit of time."""

MAX_TIME_NS = 2**62
"""Distance (146 years) of a time from 0; numbers beyond it are of another unit, or no times."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_Names = Callable[[Path], list[str]]
_Read = Callable[[Path, str, Sequence[str], Problem], Generator[Chunk, None, None]]

_BINARY: dict[str, tuple[_Names, _Read]] = {
    ".mat": (mat_names, read_mat),
    ".npz": (npz_names, read_npz),
    ".parquet": (parquet_names, read_parquet),
    ".pq": (parquet_names, read_parquet),
}
"""By the ending of the name. All others are CSV."""


class TableRows(NamedTuple):
    """Rows of a table: line (or row) of each, time (ns) and whether it is known, values (n, columns), mask of blanks.

    `problems` are those found on the way: key, line, text.
    """

    line: np.ndarray
    t: np.ndarray
    known: np.ndarray
    values: np.ndarray
    blank: np.ndarray
    problems: tuple[tuple[str, int, str], ...]


def is_text(path: Path) -> bool:
    """Return whether a table is read as a CSV, whose reader cannot crash."""
    return suffix_of(path) not in _BINARY


def names_of(path: Path) -> list[str]:
    """Return the names of a table's columns; raises SourceError if the file cannot be read as its format."""
    if is_text(path):
        return csv_header(path)[0]
    try:
        found: list[str] = read_isolated(_names, path)[0]
    except SourceError as error:
        raise _about(path, error) from None
    return found


def rows_of(
    path: Path, time: str, unit: str, columns: Sequence[str], timeout: Callable[[], float]
) -> Iterator[TableRows | None]:
    """Yield the rows of a table, some thousands at once; None where none came within `timeout()` seconds.

    Raises:
        SourceError: If the file cannot be read, or not any further.
    """
    if is_text(path):
        yield from read_rows(path, time, unit, columns)
        return
    reader = IsolatedReader(read_rows, path, time, unit, columns)
    try:
        while not reader.ended:
            item = reader.take(timeout())
            if item is not None or not reader.ended:
                yield item
    except SourceError as error:
        raise _about(path, error) from None
    finally:
        reader.close()


def _about(path: Path, error: SourceError) -> SourceError:
    """Return an error that names the file: the reader's own does, that of its process does not."""
    known = str(path) in str(error)
    return error if known else SourceError(f"{path}: it cannot be read ({error}); check that it is complete")


def read_rows(path: Path, time: str, unit: str, columns: Sequence[str]) -> Iterator[TableRows]:
    """Yield the rows of a table in this process."""
    problems: list[tuple[str, int, str]] = []

    def taken() -> tuple[tuple[str, int, str], ...]:
        found = tuple(problems)
        problems.clear()
        return found

    read = read_csv if is_text(path) else _BINARY[suffix_of(path)][1]
    for chunk in read(path, time, columns, lambda *problem: problems.append(problem)):
        t, known = column_ns(chunk.time, unit)
        yield TableRows(chunk.line, t, known, chunk.values, chunk.blank, taken())
    if problems:
        none = np.zeros(0, np.int64)
        nothing = np.zeros((0, len(columns)))
        yield TableRows(none, none, none.astype(np.bool_), nothing, nothing.astype(np.bool_), taken())


def _names(path: Path) -> Iterator[list[str]]:
    yield _BINARY[suffix_of(path)][0](path)


def column_ns(column: Any, unit: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of a column in ns, and a mask of the rows that have one.

    Args:
        column: Cells of a CSV as text, or a column of pyarrow: numbers, timestamps or text.
        unit: Unit of numbers: a key of `UNITS`.
    """
    factor = UNITS[unit]
    if isinstance(column, list):
        return _of_cells(column, factor)
    import pyarrow

    kind = column.type
    known = ~column.is_null().to_numpy(zero_copy_only=False)
    if pyarrow.types.is_timestamp(kind) or pyarrow.types.is_date(kind):
        whole = column.cast(pyarrow.timestamp("ns", getattr(kind, "tz", None))).cast(pyarrow.int64())
        return whole.fill_null(0).to_numpy(zero_copy_only=False), known
    if pyarrow.types.is_integer(kind):
        whole = column.cast(pyarrow.int64()).fill_null(0).to_numpy(zero_copy_only=False)
        known = known & (np.abs(whole) <= MAX_TIME_NS // factor)
        return np.where(known, whole, 0) * factor, known
    if pyarrow.types.is_floating(kind):
        numbers = column.cast(pyarrow.float64()).to_numpy(zero_copy_only=False)
        known = known & (np.abs(numbers) <= MAX_TIME_NS / factor)
        return to_ns(np.where(known, numbers, 0.0) * (factor / 1e9)), known
    return _of_cells([item or "" for item in column.cast(pyarrow.string()).to_pylist()], factor)


def _of_cells(cells: list[str], factor: int) -> tuple[np.ndarray, np.ndarray]:
    times = [_of_text(cell, factor) for cell in cells]
    known = np.array([t is not None for t in times], np.bool_)
    return np.array([0 if t is None else t for t in times], np.int64), known


def _of_text(text: str, unit: int) -> int | None:
    """Return one cell as ns: a number in the unit, exactly as it is written, or a date; None if it is neither."""
    if "_" in text:
        return None  # 1_000 is a number in Python only.
    try:
        number = float(text)
    except ValueError:
        return _of_date(text)
    if not np.isfinite(number):
        return None
    time = int((Decimal(text) * unit).to_integral_value())
    return time if abs(time) <= MAX_TIME_NS else None


def _of_date(text: str) -> int | None:
    """Return an ISO 8601 date as ns; without a zone it is UTC."""
    head, dot, tail = text.partition(".")
    digits = len(tail) - len(tail.lstrip("0123456789"))
    fraction, zone = tail[:digits], tail[digits:]
    try:
        when = datetime.fromisoformat(head + zone)
    except ValueError:
        return None
    if when.tzinfo is None:
        when = when.replace(tzinfo=UTC)
    delta = when - _EPOCH
    seconds = delta.days * 86400 + delta.seconds
    return seconds * 10**9 + delta.microseconds * 1000 + (int(fraction[:9].ljust(9, "0")) if dot and fraction else 0)
