"""The rows of a table with their times, of any format.

Text is read in this process; other formats in a process of their own, since their libraries can crash.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estimators.errors import SourceError, quoted

from ..formats import BAGS, suffix_of
from ..source import UNDATED
from ..worker_process import IsolatedReader, read_isolated
from .bag import bag_names, read_bag
from .binary import mat_names, npz_names, parquet_names, read_mat, read_npz, read_parquet
from .text import Chunk, Column, Problem, csv_format, read_csv
from .times import TimeColumn, TimeReader

_Names = Callable[[Path, str], list[str]]
_Read = Callable[[Path, Any, Sequence[Column], Problem], Iterator[Chunk]]

_BINARY: dict[str, tuple[_Names, _Read]] = {
    ".db3": (bag_names, read_bag),
    ".mat": (mat_names, read_mat),
    ".mcap": (bag_names, read_bag),
    ".npz": (npz_names, read_npz),
    ".parquet": (parquet_names, read_parquet),
    ".pq": (parquet_names, read_parquet),
}
"""By the ending of the name. All others are CSV."""


class TableRows(NamedTuple):
    """Rows of a table: line (or row) of each, time (ns) and whether it is known, values (n, columns), mask of blanks.

    `problems` are those found on the way: key, line, text. `words`: see `Chunk`.
    """

    line: np.ndarray
    t: np.ndarray
    known: np.ndarray
    values: np.ndarray
    blank: np.ndarray
    problems: tuple[tuple[str, int, str], ...]
    words: tuple[str, ...] = ()


def is_text(path: Path) -> bool:
    """Return whether a table is read as a CSV, whose reader cannot crash."""
    return suffix_of(path) not in _BINARY


def is_bag(path: Path) -> bool:
    """Return whether a table is a bag of ROS 2, each of whose rows has the columns of one topic."""
    return suffix_of(path) in BAGS


def names_of(path: Path, time: str = "") -> list[str]:
    """Return the names of a table's columns, or of those with as many rows as column `time`.

    Raises:
        SourceError: If the file cannot be read as its format.
    """
    if is_text(path):
        return csv_format(path).names
    try:
        found: list[str] = read_isolated(_names, path, time)[0]
    except SourceError as error:
        raise _about(path, error) from None
    return found


def rows_of(
    path: Path, time: TimeColumn, columns: Sequence[Column], timeout: Callable[[], float]
) -> Iterator[TableRows | None]:
    """Yield the rows of a table, some thousands at once; None where none came within `timeout()` seconds.

    Raises:
        SourceError: If the file cannot be read, or not any further.
    """
    if is_text(path):
        yield from read_rows(path, time, columns)
        return
    reader = IsolatedReader(read_rows, path, time, columns)
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


def read_rows(path: Path, time: TimeColumn, columns: Sequence[Column]) -> Iterator[TableRows]:
    """Yield the rows of a table in this process."""
    problems: list[tuple[str, int, str]] = []

    def taken() -> tuple[tuple[str, int, str], ...]:
        found = tuple(problems)
        problems.clear()
        return found

    text = is_text(path)
    if time.clock is not None and not text:
        raise SourceError(f"{path}: {time.label} are two columns, which only a CSV may have; give one column of times")
    read: _Read = read_csv if text else _BINARY[suffix_of(path)][1]
    times = TimeReader(time, path)
    for chunk in read(path, time.names if text else time.name, columns, lambda *problem: problems.append(problem)):
        yield dated(chunk, times, time, problems)._replace(problems=taken())
    if problems:
        none = np.zeros(0, np.int64)
        nothing = np.zeros((0, len(columns)))
        yield TableRows(none, none, none.astype(np.bool_), nothing, nothing.astype(np.bool_), taken())


def dated(chunk: Chunk, times: TimeReader, time: TimeColumn, problems: list[tuple[str, int, str]]) -> TableRows:
    """Return the rows of a chunk with their times; rows without one, or with an assumed one, join the problems."""
    t, known = times.read(chunk.time)
    for row in np.flatnonzero(~known).tolist():
        problems.append((UNDATED, int(chunk.line[row]), _undated(time, chunk.time[row])))
    problems += [(key, int(chunk.line[row]), text) for row, key, text in times.notes]
    times.notes.clear()
    return TableRows(chunk.line, t, known, chunk.values, chunk.blank, (), chunk.words)


def _undated(time: TimeColumn, cell: Any) -> str:
    """Return why a row has no time, and the remedy."""
    text = "" if cell is None else str(cell).strip()
    if text in ("", "None", "nan", "NaT"):
        return f"{time.label} is empty; the row is left out"
    rule = f"is not of the format {time.format!r}" if time.format else f"is neither a time in {time.unit} nor a date"
    return f"{time.label} is {quoted(text)}, which {rule}; the row is left out: correct it, or give its unit or format"


def _names(path: Path, time: str) -> Iterator[list[str]]:
    yield _BINARY[suffix_of(path)][0](path, time)
