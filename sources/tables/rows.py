"""The rows of a table with their times, read here if the file is text, and in a process of their own if it is not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimators.errors import SourceError

from ..reader_process import Apart, ask, patience_for
from .files import column_names, is_text, read_table
from .time_column import column_ns


class Rows(NamedTuple):
    """Rows of a table: line (or row) of each, times (ns) and which are known, values (n, columns), which are blank.

    `problems` are those found on the way: key, line, text.
    """

    line: np.ndarray
    t: np.ndarray
    known: np.ndarray
    values: np.ndarray
    blank: np.ndarray
    problems: tuple[tuple[str, int, str], ...]


def names_of(path: Path) -> list[str]:
    """Names of a table's columns.

    Raises:
        SourceError: If it is no table.
    """
    if is_text(path):
        return column_names(path)
    try:
        found: list[str] = ask(_names, path, patience=patience_for(path))[0]
    except SourceError as error:
        raise _about(path, error) from None
    return found


def rows_of(
    path: Path, time: str, unit: str, columns: Sequence[str], timeout: Callable[[], float]
) -> Iterator[Rows | None]:
    """Rows of a table, some thousands at once; None where none came within `timeout()` seconds.

    Raises:
        SourceError: If the file cannot be read, or not any further.
    """
    if is_text(path):
        yield from read_rows(path, time, unit, columns)
        return
    apart = Apart(read_rows, path, time, unit, columns, patience=patience_for(path))
    try:
        while not apart.ended:
            item = apart.take(timeout())
            if item is not None or not apart.ended:
                yield item
    except SourceError as error:
        raise _about(path, error) from None
    finally:
        apart.close()


def _about(path: Path, error: SourceError) -> SourceError:
    """What the reader itself raised names the file; what became of the reader does not."""
    known = str(path) in str(error)
    return error if known else SourceError(f"{path}: it cannot be read ({error}); check that it is whole")


def read_rows(path: Path, time: str, unit: str, columns: Sequence[str]) -> Iterator[Rows]:
    """Rows of a table of any kind."""
    problems: list[tuple[str, int, str]] = []

    def told() -> tuple[tuple[str, int, str], ...]:
        given = tuple(problems)
        problems.clear()
        return given

    for chunk in read_table(path, time, columns, lambda *problem: problems.append(problem)):
        t, known = column_ns(chunk.time, unit)
        yield Rows(chunk.line, t, known, chunk.values, chunk.blank, told())
    if problems:
        none = np.zeros(0, np.int64)
        nothing = np.zeros((0, len(columns)))
        yield Rows(none, none, none.astype(np.bool_), nothing, nothing.astype(np.bool_), told())


def _names(path: Path) -> Iterator[list[str]]:
    yield column_names(path)
