"""Sheets of a workbook as text, which is then read as a CSV: with any heading, and numbers and dates as text or not."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from estimators.errors import SourceError, nearest
from sources.tables.binary import content_of, readable
from sources.tables.dialect import HEAD_BYTES, CsvFormat, Dialect, format_of
from sources.tables.rows import TableFormat
from sources.tables.text import CHUNK_ROWS, READ_AS, Chunk, Column, Problem, after_heading, read_text


def sheet_columns(path: Path, time: str, dialect: Dialect) -> list[str]:
    """Return the columns of a sheet; raises SourceError as `_sheet`."""
    return list(_sheet(path, dialect)[1].names)


def sheet_cells(path: Path, dialect: Dialect) -> Iterator[list[list[str]]]:
    """Yield the rows of a sheet below its heading, some thousands at once."""
    text, kind, _ = _sheet(path, dialect)
    rows = list(kind.cells(after_heading(io.StringIO(text, newline=""), kind)))
    yield from (rows[k : k + CHUNK_ROWS] for k in range(0, len(rows), CHUNK_ROWS))


def read_sheet(
    path: Path, time: Sequence[str], columns: Sequence[Column], problem: Problem, dialect: Dialect
) -> Iterator[Chunk]:
    """Yield the rows of a sheet; the first problem is the remark about it, if any."""
    text, kind, remark = _sheet(path, dialect)
    if remark:
        problem(READ_AS, kind.first - 1, remark)
    yield from read_text(io.StringIO(text, newline=""), kind, time, columns, problem)


WORKBOOK = TableFormat(sheet_columns, read_sheet, dialect=True, cells=sheet_cells)


def _sheet(path: Path, dialect: Dialect) -> tuple[str, CsvFormat, str]:
    """Return the cells of the sheet with the table as a CSV, its format, and a remark.

    Raises:
        SourceError: If the file cannot be read, there is no such sheet, or none with a table.
    """
    with readable(path, "a workbook"):
        import python_calamine

        book = python_calamine.load_workbook(content_of(path))
        names = book.sheet_names
    if dialect.sheet is not None and dialect.sheet not in names:
        raise SourceError(f"{path}: there is no sheet {dialect.sheet!r}; {nearest(dialect.sheet, names)}")
    found: list[tuple[str, str, CsvFormat]] = []
    for name in names if dialect.sheet is None else [dialect.sheet]:
        out = io.StringIO()
        with readable(path, "a workbook"):
            rows = book.get_sheet_by_name(name).to_python(skip_empty_area=False)
        csv.writer(out, lineterminator="\n").writerows([_text(cell) for cell in row] for row in rows)
        text = out.getvalue()
        kind = format_of(path, text.encode()[:HEAD_BYTES], dialect._replace(delimiter=","))
        if kind.settled:
            found.append((name, text, kind))
    if not found:
        where = f"sheets {', '.join(names)} have" if dialect.sheet is None else f"sheet {dialect.sheet!r} has"
        raise SourceError(f"{path}: {where} no rows of numbers below a heading; give --heading, or another --sheet")
    name, text, kind = found[0]
    several = f"sheet {name!r} is read, of those with a table: {', '.join(one[0] for one in found)} (sheet, --sheet)"
    return text, kind, ", ".join([several] * (len(found) > 1) + [kind.remark] * bool(kind.remark))


def _text(cell: Any) -> str:
    """Return a cell as it is written in a CSV; a duration in seconds."""
    if isinstance(cell, timedelta):
        return repr(cell.total_seconds())
    if isinstance(cell, bool):
        return str(int(cell))
    return cell.isoformat(" ") if isinstance(cell, datetime) else str(cell).replace("\n", " ")
