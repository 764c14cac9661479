"""CSV files, plain or compressed: their columns, and their rows a few thousand at a time."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from estimators.errors import SourceError, quoted

from ..archives import UNREADABLE_ERRORS, open_binary
from ..source import TRUNCATED
from .dialect import DETECTED, HEAD_BYTES, QUALITY_WORD, CsvFormat, Dialect, format_of

CHUNK_ROWS = 4096  # Rows of a chunk, at most
MAX_PREAMBLE_BYTES = 2**20  # Bytes after the first ones in which a table is sought
MAX_LINE_LENGTH = 2**20  # Characters of a line; a longer one is read as several
READ_AS = "format of a table"  # Key of what was assumed about the format
UNREADABLE = "unreadable value"  # Key of values that are not numbers
NO_VALUE = "no value "  # Begin of the key of words that stand for a missing value: no value TT1: Bad

Problem = Callable[[str, int, str], None]
"""problem(key, line or row number, text)."""


class TextMatch(NamedTuple):
    """Column of a table that is 1 where the text of `column` is one of `texts`, and 0 elsewhere."""

    column: str
    texts: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.column} = {' or '.join(self.texts)}"


class TextCodes(NamedTuple):
    """Column of a table whose values are positions of the texts of `column` in `Chunk.words`."""

    column: str


Column = str | TextMatch | TextCodes
"""Column of the reader: numbers of a column of the file, or what its texts are."""


class Chunk(NamedTuple):
    """TableRows of a table: the raw time column, the values (n, columns), and a mask of blank ones.

    `line` is the line (CSV) or row (other formats) of each, counted from 1. `words` are the texts of the column that is
    read as `TextCodes`, each once.
    """

    line: np.ndarray
    time: Any
    values: np.ndarray
    blank: np.ndarray
    words: tuple[str, ...] = ()


def open_text(path: Path, kind: CsvFormat) -> TextIO:
    """Open a CSV; bytes that are not of its encoding are replaced."""
    return io.TextIOWrapper(open_binary(path), encoding=kind.encoding, errors="replace", newline="")


def after_heading(file: TextIO, kind: CsvFormat) -> TextIO:
    """Return an open CSV after its heading."""
    for _ in range(kind.first - 1):
        file.readline(MAX_LINE_LENGTH)
    return file


def csv_rows(path: Path, given: Dialect = DETECTED) -> Iterator[list[str]]:
    """Yield the cells of the rows of a CSV."""
    kind = csv_format(path, given)
    with open_text(path, kind) as file, suppress(csv.Error):  # It is reported when the rows are read.
        yield from filter(kind.fits, kind.cells(after_heading(file, kind)))


def csv_format(path: Path, given: Dialect = DETECTED) -> CsvFormat:
    """Return the format of a CSV, detected from its first lines as far as it is not given.

    Raises:
        SourceError: If the file cannot be decompressed, or as `format_of`.
    """
    try:
        with open_binary(path) as binary:
            found = format_of(path, head := binary.read(HEAD_BYTES), given)
            if not found.settled and len(head) == HEAD_BYTES:
                found = format_of(path, head + binary.read(MAX_PREAMBLE_BYTES), given)
            return found
    except UNREADABLE_ERRORS as error:
        why = getattr(error, "strerror", None) or error
        raise SourceError(f"{path}: it cannot be read ({why}); check that it is complete") from None


def has_rows(path: Path, given: Dialect = DETECTED) -> bool:
    """Return whether anything follows the heading of a CSV."""
    with suppress(*UNREADABLE_ERRORS):
        kind = csv_format(path, given)
        with open_text(path, kind) as file:
            return kind.settled or any(line.strip() for line in after_heading(file, kind))
    return True  # What is wrong with the file is reported when its rows are read.


def read_csv(
    path: Path, time: Sequence[str], columns: Sequence[Column], problem: Problem, given: Dialect = DETECTED
) -> Iterator[Chunk]:
    """Yield the rows of a CSV; a value that is not a number is missing and reported, as is a row cut short."""
    kind = csv_format(path, given)
    with open_text(path, kind) as file:
        yield from read_text(file, kind, time, columns, problem)


def read_text(
    file: TextIO, kind: CsvFormat, time: Sequence[str], columns: Sequence[Column], problem: Problem
) -> Iterator[Chunk]:
    """Yield the rows of a CSV, see `read_csv`."""
    width, before = len(kind.names), kind.first - 1
    broken: tuple[int, list[str]] | None = None
    raw: list[str] = []
    reader = kind.cells(_lines(after_heading(file, kind), raw))
    ended = False
    while not ended:
        rows: list[list[str]] = []
        lines: list[int] = []
        while len(rows) < CHUNK_ROWS and not ended:
            raw.clear()
            fault = ""
            try:
                row = next(reader, None)
            except (csv.Error, *UNREADABLE_ERRORS) as error:
                row, fault = None, f"{error}; the rest is left out"
            if len(raw) > 1 and sum(line.count('"') for line in raw) % 2:
                # Quotes come in pairs, so this one took all that follows for one cell.
                after = "all after it" if fault else f"the {len(raw) - 1} after it"
                row, fault = None, f"a quote is opened and not closed; this line and {after} are left out"
            if fault:
                problem(TRUNCATED, before + reader.line_num - len(raw) + 1, fault)
            if row is None:
                ended = True
            elif row:
                if broken is not None:
                    problem(UNREADABLE, broken[0], f"has {len(broken[1])} cells, not {width}; the row is left out")
                broken = None if len(row) == width or kind.fits(row) else (before + reader.line_num, row)
                if broken is None:
                    rows.append(row)
                    lines.append(before + reader.line_num)
        if rows:
            yield chunk_of(rows, lines, kind, time, columns, problem)
    if broken is not None:
        footer = len(broken[1]) == 1 and not any(map(str.isdigit, broken[1][0]))
        text = f"is {quoted(broken[1][0].strip())}, which is no row of the table; it is left out"
        cut = f"the last line has {len(broken[1])} cells, not {width}"
        problem(UNREADABLE if footer else TRUNCATED, broken[0], text if footer else cut)


def chunk_of(
    rows: list[list[str]],
    lines: list[int],
    kind: CsvFormat,
    time: Sequence[str],
    columns: Sequence[Column],
    problem: Problem,
) -> Chunk:
    """Return the cells of rows, at these lines of a CSV, as numbers; `time` names its columns, one or two."""
    values = np.empty((len(rows), len(columns)))
    blank = np.zeros(values.shape, np.bool_)
    codes: dict[str, int] = {}
    for k, name in enumerate(columns):
        place = kind.names.index(column_of(name))
        if isinstance(name, TextCodes):
            cells = [row[place].strip() for row in rows]
            values[:, k] = [codes.setdefault(cell, len(codes)) for cell in cells]
            blank[:, k] = [not cell for cell in cells]
            continue
        fill(name, [row[place] for row in rows], lines, values[:, k], blank[:, k], problem, kind.decimal, kind.group)
    at_time = [kind.names.index(name) for name in time]
    parts = ([row[place].strip() for place in at_time] for row in rows)
    times = [" ".join(part) if all(part) else "" for part in parts]
    if kind.decimal == "," or kind.group:
        times = [cell if one == "?" else one for one, cell in zip(_plain(times, kind.decimal, kind.group), times)]
    return Chunk(np.array(lines), times, values, blank, tuple(codes))


def _lines(file: TextIO, raw: list[str]) -> Iterator[str]:
    """Yield the lines of a file, and append them to `raw`."""
    while line := file.readline(MAX_LINE_LENGTH):
        raw.append(line)
        yield line


_COMMA = re.compile(r"[+-]?(?:\d*|\d{1,3}(?:\.\d{3})+),\d+(?:[eE][+-]?\d+)?")


def _with_point(text: str) -> str | None:
    """Return a number that is written with a decimal comma as one with a point; None of anything else."""
    text = text.strip()
    return text.replace(".", "").replace(",", ".") if _COMMA.fullmatch(text) else None


def _plain(cells: list[str], decimal: str, group: str) -> list[str]:
    """Return numbers as Python writes them; "?" in place of one with a point in a table of decimal commas."""
    if group:
        pattern = re.compile(rf"\s*[+-]?\d{{1,3}}(?:[{group}]\d{{3}})+(?:\{decimal}\d*)?(?:[eE][+-]?\d+)?\s*")
        bare = str.maketrans({sign: "" for sign in group} | {decimal: "."})
        found = [cell.translate(bare) if pattern.fullmatch(cell) else "" for cell in cells]
    if decimal != ",":
        return [one or cell for one, cell in zip(found, cells)] if group else cells
    texts = [_with_point(cell) or ("?" if "." in cell else cell) for cell in cells]
    return [one or text for one, text in zip(found, texts)] if group else texts


def column_of(name: Column) -> str:
    """Return the column of the file that a column of the reader is made of."""
    return name if isinstance(name, str) else name.column


def no_value(name: str, text: str) -> tuple[str, str] | None:
    """Return key and text of the report of a word of quality in place of a value; None of any other text."""
    if not QUALITY_WORD.fullmatch(word := text.strip()):
        return None
    return f"{NO_VALUE}{name}: {word[:40]}", f"{name} is {quoted(word)}; the value is missing"


def fill(
    name: str | TextMatch,
    cells: list[str],
    lines: list[int],
    values: np.ndarray,
    blank: np.ndarray,
    problem: Problem,
    decimal: str = ".",
    group: str = "",
) -> None:
    """Fill a column of values, and its mask of blank ones, from text; with a decimal comma, a point is an error.

    `group` are the signs between thousands.
    """
    if isinstance(name, TextMatch):
        values[:] = [cell.strip() in name.texts for cell in cells]
        blank[:] = [not cell.strip() for cell in cells]
        return
    texts = _plain(cells, decimal, group)
    try:
        if "_" not in "".join(texts):
            values[:] = [float(cell) for cell in texts]
            return
    except ValueError:
        pass
    for k, cell in enumerate(cells):
        try:
            values[k] = float("?" if "_" in cell else texts[k])  # `1_000` is a number in Python only.
        except ValueError:
            values[k] = np.nan
            if not cell.strip():
                blank[k] = True
            elif cell.strip().lower() not in ("na", "n/a", "null", "none"):
                if word := no_value(name, cell):
                    problem(word[0], lines[k], word[1])
                    continue
                point = _with_point(cell)
                why = "which is not a number" if point is None else f"with a decimal comma; write {point}"
                if texts[k] == "?":
                    why = "with a point in a table of decimal commas"
                problem(UNREADABLE, lines[k], f"{name} is {quoted(cell.strip())}, {why}; the value is missing")
