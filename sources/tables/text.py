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

from ..formats import open_binary, refuse_others
from ..source import TRUNCATED

CHUNK_ROWS = 4096  # Rows of a chunk, at most
MAX_LINE_LENGTH = 2**20  # Characters of a line; a longer one is read as several
HEAD_BYTES = 65_536  # Bytes from which the format of a CSV is detected
UNREADABLE = "unreadable value"  # Key of values that are not numbers
NO_VALUE = "no value "  # Begin of the key of words that stand for a missing value: no value TT1: Bad

QUALITY_WORD = re.compile(
    r"(\[-?\d+\] *)?(bad|uncertain|questionable|invalid|error|fault|fail(ed|ure)?|stale|offline|shutdown|scan off"
    r"|disconnect|(over|under) ?range|no (data|good|result|sample|value)|not connected|out of (service|range)"
    r"|comm\w* (fail|error)|(i/?o |intf )?(time ?out|shut)|calc failed|pt created|configure)\b.*"
    r"|#(n/a|value!|div/0!|ref!|num!)",
    re.IGNORECASE,
)
"""Words by which historians, OPC servers and spreadsheets mark a value that there is not."""

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


class CsvFormat(NamedTuple):
    """Columns of a CSV, the delimiter of its cells, the decimal sign of its numbers, and its encoding."""

    names: list[str]
    delimiter: str
    decimal: str
    encoding: str


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


def open_text(path: Path, encoding: str = "utf-8-sig") -> TextIO:
    """Open a CSV; bytes that are not of its encoding are replaced."""
    return io.TextIOWrapper(open_binary(path), encoding=encoding, errors="replace", newline="")


def csv_format(path: Path) -> CsvFormat:
    """Return the format of a CSV, detected from its first lines.

    Files that are not UTF-8 are read as Windows-1252, or as UTF-16 if they begin with its mark. The decimal sign is a
    comma if the delimiter is another sign and a number is written with one.

    Raises:
        SourceError: If the file begins with bytes that are not text, or cannot be decompressed.
    """
    try:
        with open_binary(path) as binary:
            head = binary.read(HEAD_BYTES)
    except OSError as error:
        raise SourceError(f"{path}: it cannot be read ({error.strerror or error}); check that it is complete") from None
    return format_of(path, head)


def format_of(path: Path, head: bytes) -> CsvFormat:
    """Return the format of a CSV that begins with these bytes.

    Raises:
        SourceError: If they are not text.
    """
    refuse_others(path, head)
    encoding = "utf-16" if head.startswith((b"\xff\xfe", b"\xfe\xff")) else _single_bytes(head)
    if encoding != "utf-16" and any(byte < 9 or 13 < byte < 32 for byte in head[:4096]):
        raise SourceError(
            f"{path}:1: it begins with the bytes {head[:8].hex(' ')} and is not text; give a CSV in UTF-8, "
            "or name the file by its format (.parquet, .mat, .npz)"
        )
    lines = head.decode(encoding, "replace").splitlines()
    first = lines[0] if lines else ""
    delimiter = max(",;\t|", key=first.count)
    names = next(csv.reader([first], delimiter=delimiter), [])
    cells = (cell for line in lines[1:-1] or lines[1:] for cell in line.split(delimiter))
    comma = delimiter != "," and any(_COMMA.fullmatch(cell.strip()) for cell in cells)
    return CsvFormat([name.strip() for name in names], delimiter, "," if comma else ".", encoding)


def _single_bytes(head: bytes) -> str:
    try:
        head.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 4:  # not merely cut within a character
            return "cp1252"
    return "utf-8-sig"


def has_rows(path: Path) -> bool:
    """Return whether anything follows the first line of a CSV."""
    with suppress(OSError), open_text(path) as file:
        file.readline(MAX_LINE_LENGTH)
        return any(line.strip() for line in file)
    return True  # What is wrong with the file is reported when its rows are read.


def read_csv(path: Path, time: Sequence[str], columns: Sequence[Column], problem: Problem) -> Iterator[Chunk]:
    """Yield the rows of a CSV; a value that is not a number is missing and reported, as is a row cut short."""
    kind = csv_format(path)
    names, delimiter, _, encoding = kind
    broken: tuple[int, int] | None = None
    raw: list[str] = []
    with open_text(path, encoding) as file:
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
                yield chunk_of(rows, lines, kind, time, columns, problem)
    if broken is not None:
        problem(TRUNCATED, broken[0], f"the last line has {broken[1]} cells, not {len(names)}")


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
        fill(name, [row[place] for row in rows], lines, values[:, k], blank[:, k], problem, kind.decimal)
    at_time = [kind.names.index(name) for name in time]
    parts = ([row[place].strip() for place in at_time] for row in rows)
    times = [" ".join(part) if all(part) else "" for part in parts]
    if kind.decimal == ",":
        times = [_with_point(cell) or cell for cell in times]
    return Chunk(np.array(lines), times, values, blank, tuple(codes))


def _lines(file: TextIO, raw: list[str]) -> Iterator[str]:
    """Yield the lines of a file, and append them to `raw`."""
    while line := file.readline(MAX_LINE_LENGTH):
        raw.append(line)
        yield line


_COMMA = re.compile(r"[+-]?(?:\d*|\d{1,3}(?:\.\d{3})+),\d+(?:[eE][+-]?\d+)?")


def _with_point(cell: str) -> str | None:
    """Return a number that is written with a decimal comma as one with a point; None of anything else."""
    text = cell.strip()
    return text.replace(".", "").replace(",", ".") if _COMMA.fullmatch(text) else None


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
) -> None:
    """Fill a column of values, and its mask of blank ones, from text; with a decimal comma, a point is an error."""
    if isinstance(name, TextMatch):
        values[:] = [cell.strip() in name.texts for cell in cells]
        blank[:] = [not cell.strip() for cell in cells]
        return
    texts = cells
    if decimal == ",":
        texts = [_with_point(cell) or ("?" if "." in cell else cell) for cell in cells]
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
