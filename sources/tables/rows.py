"""The rows of a table with their times, of any format.

Text is read in this process; other formats in a process of their own, since their libraries can crash.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimators.errors import SourceError, quoted

from .. import formats
from ..source import UNDATED
from ..worker_process import IsolatedReader, read_isolated
from .binary import arrow_names, mat_names, npz_names, parquet_names, read_arrow, read_mat, read_npz, read_parquet
from .dialect import DETECTED, Dialect
from .text import Chunk, Column, csv_format, csv_rows, read_csv
from .times import TimeColumn, TimeReader

_Names = Callable[..., list[str]]
_Read = Callable[..., Iterator[Chunk]]


class TableFormat(NamedTuple):
    """How a table that is no CSV is read, in a process of its own; its functions are importable by name.

    `names(path, time)`, `read(path, time, columns, problem)`. Rows of a `sparse` one have only some of the columns.
    With `dialect`, the functions take a `Dialect` as the last argument. One whose `cells` are text, as lists of rows by
    `cells(path, dialect)`, may have two columns of time: `read` takes the names of the time.
    """

    names: _Names
    read: _Read
    sparse: bool = False
    dialect: bool = False
    cells: Callable[..., Iterator[list[list[str]]]] | None = None


_FORMATS = {
    ".arrow": TableFormat(arrow_names, read_arrow),
    ".csv": None,
    ".feather": TableFormat(arrow_names, read_arrow),
    ".mat": TableFormat(mat_names, read_mat),
    ".npz": TableFormat(npz_names, read_npz),
    ".parquet": TableFormat(parquet_names, read_parquet),
    ".pq": TableFormat(parquet_names, read_parquet),
}
"""By the ending of the name; None for a CSV."""


class TableRows(NamedTuple):
    """Rows of a table: line (or row) of each, time (ns) and whether it is known, values (n, columns), mask of blanks.

    `problems` are those found on the way: key, line, text. `words`: see `Chunk`. `unit` is that of the times.
    `zoneless` tells whether dates before or in them have no time zone.
    """

    line: np.ndarray
    t: np.ndarray
    known: np.ndarray
    values: np.ndarray
    blank: np.ndarray
    problems: tuple[tuple[str, int, str], ...]
    words: tuple[str, ...] = ()
    unit: str = "s"
    zoneless: bool = False


def format_of(path: Path) -> TableFormat | None:
    """Return how a table is read, by the ending of its name; None of a CSV, as all others are.

    Raises:
        SourceError: If its extension is missing.
    """
    suffix = formats.suffix_of(path)
    if suffix in formats.MDF and not formats.holds_signals(path):
        return None
    if suffix in _FORMATS:
        return _FORMATS[suffix]
    if suffix in (found := formats.added("tables")):
        form: TableFormat = found[suffix]()
        return form
    if extra := formats.EXTRAS.get(suffix):
        raise SourceError(f"{path}: needs the extension {extra}, which is not there: pip install 'nisus[{extra}]'")
    return None


def is_text(path: Path) -> bool:
    """Return whether a table is read as a CSV, whose reader cannot crash."""
    return format_of(path) is None


def cells_of(path: Path, dialect: Dialect = DETECTED) -> Iterator[list[str]] | None:
    """Return the cells of the rows of a table of text; None of any other one."""
    form = format_of(path)
    if form is None:
        return csv_rows(path, dialect)
    return None if form.cells is None else chain.from_iterable(read_isolated(form.cells, path, dialect))


def names_of(path: Path, time: str = "", dialect: Dialect = DETECTED) -> list[str]:
    """Return the names of a table's columns, or of those with as many rows as column `time`.

    Raises:
        SourceError: If the file cannot be read as its format.
    """
    form = format_of(path)
    if form is None:
        return list(csv_format(path, dialect).names)
    try:
        found: list[str] = read_isolated(_names, path, time, form, dialect)[0]
    except SourceError as error:
        raise _about(path, error) from None
    return found


def remarks_of(files: Sequence[Path], dialect: Dialect = DETECTED) -> list[str]:
    """Return what was assumed about the format of CSV files, where it is not plain: a line for all with the same."""
    found: dict[str, list[str]] = {}
    for path in files:
        if is_text(path) and (remark := csv_format(path, dialect).remark):
            found.setdefault(remark, []).append(path.name)
    return [f"{n[0]}{f' and {len(n) - 1} more' * (len(n) > 1)}: {remark}" for remark, n in found.items()]


def rows_of(
    path: Path,
    time: TimeColumn,
    columns: Sequence[Column],
    timeout: Callable[[], float],
    dialect: Dialect = DETECTED,
) -> Iterator[TableRows | None]:
    """Yield the rows of a table, some thousands at once; None where none came within `timeout()` seconds.

    Raises:
        SourceError: If the file cannot be read, or not any further.
    """
    form = format_of(path)
    if form is None:
        try:
            yield from read_rows(path, time, columns, form, dialect)
        except SourceError as error:
            raise error if str(path) in str(error) else SourceError(f"{path}: {error}") from None
        return
    reader = IsolatedReader(read_rows, path, time, columns, form, dialect)
    try:
        while not reader.ended:
            item = reader.get(timeout())
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


def read_rows(
    path: Path, time: TimeColumn, columns: Sequence[Column], form: TableFormat | None, dialect: Dialect = DETECTED
) -> Iterator[TableRows]:
    """Yield the rows of a table in this process, which may know no extension; `form` is that of `format_of`."""
    problems: list[tuple[str, int, str]] = []

    def taken() -> tuple[tuple[str, int, str], ...]:
        found = tuple(problems)
        problems.clear()
        return found

    text = form is None or form.cells is not None
    if time.clock is not None and not text:
        raise SourceError(f"{path}: {time.label} are two columns, which only text may have; give one column of times")
    read = read_csv if form is None else form.read
    more = (dialect,) if form is None or form.dialect else ()
    times = TimeReader(time, path)
    for chunk in read(path, time.names if text else time.name, columns, lambda *one: problems.append(one), *more):
        yield dated(chunk, times, time, problems)._replace(problems=taken())
    if problems:
        none = np.zeros(0, np.int64)
        nothing = np.zeros((0, len(columns)))
        yield TableRows(
            none,
            none,
            none.astype(np.bool_),
            nothing,
            nothing.astype(np.bool_),
            taken(),
            (),
            times.unit,
            times.zoneless,
        )


def dated(chunk: Chunk, times: TimeReader, time: TimeColumn, problems: list[tuple[str, int, str]]) -> TableRows:
    """Return the rows of a chunk with their times; rows without one, or with an assumed one, join the problems."""
    t, known = times.read(chunk.time)
    for row in np.flatnonzero(~known).tolist():
        problems.append((UNDATED, int(chunk.line[row]), _undated(time, chunk.time[row])))
    problems += [(key, int(chunk.line[row]), text) for row, key, text in times.notes]
    times.notes.clear()
    return TableRows(chunk.line, t, known, chunk.values, chunk.blank, (), chunk.words, times.unit, times.zoneless)


def _undated(time: TimeColumn, cell: object) -> str:
    """Return why a row has no time, and the remedy."""
    text = "" if cell is None else str(cell).strip()
    if text in ("", "None", "nan", "NaT"):
        return f"{time.label} is empty; the row is left out"
    rule = f"is not of the format {time.format!r}" if time.format else f"is neither a time in {time.unit} nor a date"
    return f"{time.label} is {quoted(text)}, which {rule}; the row is left out: correct it, or give its unit or format"


def _names(path: Path, time: str, form: TableFormat, dialect: Dialect) -> Iterator[list[str]]:
    yield form.names(path, time, dialect) if form.dialect else form.names(path, time)
