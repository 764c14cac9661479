"""CSV files, plain or compressed: their columns, and their rows a few thousand at a time."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from estimators.errors import SourceError, quoted

from ..formats import open_binary
from ..source import TRUNCATED

CHUNK_ROWS = 4096  # Rows of a chunk, at most
MAX_LINE_LENGTH = 2**20  # Characters of a line; a longer one is read as several
COMMA_CHECK_LINES = 100  # Lines in which a decimal comma is sought before a table is read
UNREADABLE = "unreadable value"  # Key of values that are not numbers

Problem = Callable[[str, int, str], None]
"""problem(key, line or row number, text)."""


class Chunk(NamedTuple):
    """TableRows of a table: the raw time column, the values (n, columns), and a mask of blank ones.

    `line` is the line (CSV) or row (other formats) of each, counted from 1.
    """

    line: np.ndarray
    time: Any
    values: np.ndarray
    blank: np.ndarray


def open_text(path: Path) -> TextIO:
    """Open a CSV; bytes that are not UTF-8 are replaced."""
    return io.TextIOWrapper(open_binary(path), encoding="utf-8-sig", errors="replace", newline="")


def csv_header(path: Path) -> tuple[list[str], str]:
    """Return the names in the first line of a CSV, and its delimiter.

    Raises:
        SourceError: If the file begins with bytes that are not text, or cannot be decompressed.
    """
    try:
        with open_binary(path) as binary:
            head = binary.read(4096)
        if any(byte < 9 or 13 < byte < 32 for byte in head):
            raise SourceError(
                f"{path}:1: it begins with the bytes {head[:8].hex(' ')} and is not text; give a CSV in UTF-8, "
                "or name the file by its format (.parquet, .mat, .npz)"
            )
        with open_text(path) as file:
            first = file.readline(MAX_LINE_LENGTH)
    except OSError as error:
        raise SourceError(f"{path}: it cannot be read ({error.strerror or error}); check that it is complete") from None
    delimiter = max(",;\t", key=first.count)
    names = next(csv.reader([first], delimiter=delimiter), [])
    return [name.strip() for name in names], delimiter


def has_rows(path: Path) -> bool:
    """Return whether anything follows the first line of a CSV."""
    with suppress(OSError), open_text(path) as file:
        file.readline(MAX_LINE_LENGTH)
        return any(line.strip() for line in file)
    return True  # What is wrong with the file is reported when its rows are read.


def read_csv(path: Path, time: str, columns: Sequence[str], problem: Problem) -> Generator[Chunk, None, None]:
    """Yield the rows of a CSV; a value that is not a number is missing and reported, as is a row cut short."""
    names, delimiter = csv_header(path)
    at_time = names.index(time)
    places = [names.index(name) for name in columns]
    broken: tuple[int, int] | None = None
    raw: list[str] = []
    with open_text(path) as file:
        reader = csv.reader(_lines(file, raw), delimiter=delimiter)
        next(reader)
        ended = False
        while not ended:
            rows: list[list[str]] = []
            lines: list[int] = []
            while len(rows) < CHUNK_ROWS and not ended:
                raw.clear()
                fault = ""
                try:
                    row = next(reader, None)
                except (csv.Error, OSError) as error:
                    row, fault = None, f"{error}; the rest is left out"
                if len(raw) > 1 and sum(line.count('"') for line in raw) % 2:
                    # Quotes come in pairs, so this one took all that follows for one cell.
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
                    parse_numbers([row[place] for row in rows], columns[k], lines, values[:, k], blank[:, k], problem)
                yield Chunk(np.array(lines), [row[at_time].strip() for row in rows], values, blank)
    if broken is not None:
        problem(TRUNCATED, broken[0], f"the last line has {broken[1]} cells, not {len(names)}")


def _lines(file: TextIO, raw: list[str]) -> Iterator[str]:
    """Yield the lines of a file, and append them to `raw`."""
    while line := file.readline(MAX_LINE_LENGTH):
        raw.append(line)
        yield line


_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


def _with_point(cell: str) -> str | None:
    """Return a number that is written with a decimal comma as one with a point; None of anything else."""
    text = cell.strip()
    return text.replace(",", ".") if _COMMA.fullmatch(text) else None


def find_decimal_comma(path: Path, wanted: Sequence[str]) -> tuple[int, str, str, str] | None:
    """Return line, column, cell, and the cell with a point, of the first decimal comma near the start of a CSV."""
    names, delimiter = csv_header(path)
    if delimiter == ",":
        return None
    places = {name: names.index(name) for name in wanted}
    with open_text(path) as file:
        reader = csv.reader(islice(_lines(file, []), COMMA_CHECK_LINES), delimiter=delimiter)
        with suppress(csv.Error, OSError):
            for row in islice(reader, 1, None):
                for name, place in places.items():
                    point = _with_point(row[place]) if place < len(row) else None
                    if point is not None:
                        return reader.line_num, name, row[place].strip(), point
    return None


def _number(cell: str) -> float:
    """Return a cell as a number; `1_000` is one in Python only.

    Raises:
        ValueError: If it is not a number.
    """
    if "_" in cell:
        raise ValueError(cell)
    return float(cell)


def parse_numbers(
    cells: list[str], name: str, lines: list[int], values: np.ndarray, blank: np.ndarray, problem: Problem
) -> None:
    """Fill a column of values, and its mask of blank ones, from text."""
    try:
        if "_" not in "".join(cells):
            values[:] = [float(cell) for cell in cells]
            return
    except ValueError:
        pass
    for k, cell in enumerate(cells):
        try:
            values[k] = _number(cell)
        except ValueError:
            values[k] = np.nan
            if not cell.strip():
                blank[k] = True
            elif cell.strip().lower() not in ("na", "n/a", "null", "none"):
                point = _with_point(cell)
                why = "which is not a number" if point is None else f"with a decimal comma; write {point}"
                problem(UNREADABLE, lines[k], f"{name} is {quoted(cell.strip())}, {why}; the value is missing")
