"""The columns of CSV, Parquet, MATLAB and NumPy files, a few thousand rows at a time."""

from __future__ import annotations

import csv
import re
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from estimators.errors import SourceError, quoted

from ..source import TRUNCATED
from .chunk import CHUNK, Chunk, Problem

LONGEST = 2**20
"""Letters in a line of column names."""

FIRST = 100
"""Lines in which a decimal comma is sought before a table is read."""

UNREADABLE = "unreadable value"


def column_names(path: Path) -> list[str]:
    """Names of a file's columns."""
    if is_mat(path):
        from .mat import mat_names

        return mat_names(path)
    if is_npz(path):
        from .npz import npz_names

        return npz_names(path)
    return parquet_names(path) if is_parquet(path) else _header(path)[0]


def read_table(path: Path, time: str, columns: Sequence[str], problem: Problem) -> Generator[Chunk, None, None]:
    """Rows of a table of any kind, by the ending of its name."""
    if is_mat(path):
        from .mat import read_mat

        return read_mat(path, time, columns, problem)
    if is_npz(path):
        from .npz import read_npz

        return read_npz(path, time, columns, problem)
    return (read_parquet if is_parquet(path) else read_csv)(path, time, columns, problem)


def is_text(path: Path) -> bool:
    """Whether it is read as a CSV, whose reader cannot crash."""
    return not (is_mat(path) or is_npz(path) or is_parquet(path))


def is_mat(path: Path) -> bool:
    """Whether the name says that it is a MATLAB file."""
    return path.suffix.lower() == ".mat"


def is_npz(path: Path) -> bool:
    """Whether the name says that it is a NumPy archive."""
    return path.suffix.lower() == ".npz"


def is_parquet(path: Path) -> bool:
    """Whether the name says so."""
    return path.suffix.lower() in (".parquet", ".pq")


def parquet_names(path: Path) -> list[str]:
    """Columns of a Parquet file.

    Raises:
        SourceError: If it is none, or cut short: its columns are listed at its end.
    """
    import pyarrow
    import pyarrow.parquet

    try:
        return list(pyarrow.parquet.read_schema(path).names)
    except (pyarrow.ArrowException, OSError) as error:
        gist = " ".join(str(error).split())[:160]
        raise SourceError(f"{path}: it cannot be read as Parquet ({gist}); check that it is whole") from None


def _header(path: Path) -> tuple[list[str], str]:
    """Names in the first line of a CSV, and the mark between them.

    Raises:
        SourceError: If it begins with bytes that no text has.
    """
    with path.open("rb") as binary:
        head = binary.read(CHUNK)
    if any(byte < 9 or 13 < byte < 32 for byte in head):
        raise SourceError(
            f"{path}:1: it begins with the bytes {head[:8].hex(' ')} and is not text; give a CSV in UTF-8, "
            "or name the file by what it is (.parquet, .mat, .npz)"
        )
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        first = file.readline(LONGEST)
    mark = max(",;\t", key=first.count)
    names = next(csv.reader([first], delimiter=mark), [])
    return [name.strip() for name in names], mark


def read_csv(path: Path, time: str, columns: Sequence[str], problem: Problem) -> Generator[Chunk, None, None]:
    """Rows of a CSV; text that is not a number counts as missing and goes to `problem`, as a row cut short does."""
    names, mark = _header(path)
    at_time = names.index(time)
    places = [names.index(name) for name in columns]
    broken: tuple[int, int] | None = None
    raw: list[str] = []
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        reader = csv.reader(_kept(file, raw), delimiter=mark)
        next(reader)
        ended = False
        while not ended:
            rows: list[list[str]] = []
            lines: list[int] = []
            while len(rows) < CHUNK and not ended:
                raw.clear()
                fault = ""
                try:
                    row = next(reader, None)
                except csv.Error as error:
                    row, fault = None, f"{error}; the rest is left out"
                if len(raw) > 1 and sum(line.count('"') for line in raw) % 2:
                    # Quotes come in pairs, so that this one took all that follows for one cell.
                    after = "all after it" if fault else f"the {len(raw) - 1} after it"
                    row, fault = None, f"a quote is opened and not closed; this line and {after} are left out"
                if fault:
                    problem(TRUNCATED, reader.line_num - len(raw) + 1, fault)
                if row is None:
                    ended = True
                elif row:
                    if broken is not None:
                        problem(UNREADABLE, broken[0], f"has {broken[1]} cells, not {len(names)}; the row is left out")
                    broken = None if len(row) == len(names) else (reader.line_num, len(row))
                    if broken is None:
                        rows.append(row)
                        lines.append(reader.line_num)
            if rows:
                values = np.empty((len(rows), len(columns)))
                blank = np.zeros(values.shape, np.bool_)
                for k, place in enumerate(places):
                    _numbers([row[place] for row in rows], columns[k], lines, values[:, k], blank[:, k], problem)
                yield Chunk(np.array(lines), [row[at_time].strip() for row in rows], values, blank)
    if broken is not None:
        problem(TRUNCATED, broken[0], f"the last line has {broken[1]} cells, not {len(names)}")


def _kept(file: TextIO, raw: list[str]) -> Iterator[str]:
    """The lines of a file; `raw` takes them too."""
    for line in file:
        raw.append(line)
        yield line


_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


def decimal_comma(cell: str) -> str | None:
    """A number that is written with a decimal comma as one with a point; None of anything else."""
    text = cell.strip()
    return text.replace(",", ".") if _COMMA.fullmatch(text) else None


def find_decimal_comma(path: Path, wanted: Sequence[str]) -> tuple[int, str, str, str] | None:
    """Line, column, cell, and the cell with a point, of the first decimal comma among the first rows of a CSV."""
    names, mark = _header(path)
    if mark == ",":
        return None
    places = {name: names.index(name) for name in wanted}
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        reader = csv.reader(islice(file, FIRST), delimiter=mark)
        with suppress(csv.Error):
            for row in islice(reader, 1, None):
                for name, place in places.items():
                    point = decimal_comma(row[place]) if place < len(row) else None
                    if point is not None:
                        return reader.line_num, name, row[place].strip(), point
    return None


def number(cell: str) -> float:
    """A cell as a number, as tables write them: 1_000 is one in a program only.

    Raises:
        ValueError: If it is none.
    """
    if "_" in cell:
        raise ValueError(cell)
    return float(cell)


def _numbers(
    cells: list[str], name: str, lines: list[int], values: np.ndarray, blank: np.ndarray, problem: Problem
) -> None:
    """Fill a column of values from text."""
    try:
        if "_" not in "".join(cells):
            values[:] = [float(cell) for cell in cells]
            return
    except ValueError:
        pass
    for k, cell in enumerate(cells):
        try:
            values[k] = number(cell)
        except ValueError:
            values[k] = np.nan
            if not cell.strip():
                blank[k] = True
            elif cell.strip().lower() not in ("na", "n/a", "null", "none"):
                point = decimal_comma(cell)
                why = "which is not a number" if point is None else f"with a decimal comma; write {point}"
                problem(UNREADABLE, lines[k], f"{name} is {quoted(cell.strip())}, {why}; the value is missing")


def read_parquet(path: Path, time: str, columns: Sequence[str], problem: Problem) -> Generator[Chunk, None, None]:
    """Rows of a Parquet file; null is blank, and text is read as in a CSV."""
    import pyarrow
    import pyarrow.parquet

    row = 1
    with pyarrow.parquet.ParquetFile(path) as file:
        for batch in file.iter_batches(CHUNK, columns=list(dict.fromkeys((time, *columns)))):
            n = batch.num_rows
            values = np.empty((n, len(columns)))
            blank = np.zeros(values.shape, np.bool_)
            lines = list(range(row, row + n))
            for k, name in enumerate(columns):
                column = batch.column(name)
                blank[:, k] = column.is_null().to_numpy(zero_copy_only=False)
                if pyarrow.types.is_string(column.type) or pyarrow.types.is_large_string(column.type):
                    cells = [item or "" for item in column.to_pylist()]
                    _numbers(cells, name, lines, values[:, k], blank[:, k], problem)
                else:
                    numbers = column.cast(pyarrow.float64(), safe=False)
                    values[:, k] = numbers.to_numpy(zero_copy_only=False)
            yield Chunk(np.array(lines), batch.column(time), values, blank)
            row += n
        if row - 1 != file.metadata.num_rows:
            problem(TRUNCATED, row, f"{row - 1} of {file.metadata.num_rows} rows are there")
