"""The dialect of a CSV: where its heading is, and how its cells and numbers are written."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

from estimators.errors import SourceError, quoted

from ..dates import CLOCK, layout, ns_of_iso
from ..formats import refuse_others
from ..units import heading_unit

HEAD_BYTES = 65_536  # Bytes from which the format of a CSV is detected
DELIMITERS = ",;\t| "
SAMPLE_LINES = 100  # Last lines of the head, which show the delimiter and the number of columns
MIN_SHARE = 0.2  # Of the last lines that are rows of a table without a heading
MAX_CELL_LINES = 8  # Lines of a cell with line breaks

QUALITY_WORD = re.compile(
    r"(\[-?\d+\] *)?(bad|uncertain|questionable|invalid|error|fault|fail(ed|ure)?|stale|offline|shutdown|scan off"
    r"|disconnect|(over|under) ?range|no (data|good|result|sample|value)|not connected|out of (service|range)"
    r"|comm\w* (fail|error)|(i/?o |intf )?(time ?out|shut)|calc failed|pt created|configure)\b.*"
    r"|#(n/a|value!|div/0!|ref!|num!)",
    re.IGNORECASE,
)
"""Words by which historians, OPC servers and spreadsheets mark a value that there is not."""

TIME_NAMES = (
    "time", "timestamp", "t", "ts", "seconds", "time_s", "t_s", "date", "datetime", "unix_time", "elapsed", "zeit",
    "zeitstempel", "datum", "horodatage", "fecha", "x_value",
)  # fmt: skip
"""Usual names of a time column, the surest first; else the first of dates, or the first that is named like one."""

TIME_NAME = re.compile(r"^t[_ ]|time|epoch|zeit|datum", re.IGNORECASE)


class Dialect(NamedTuple):
    """How a table is written, as far as it is given; None is detected.

    heading: Line of the heading, from 1 on; 0 if there is none. delimiter: Between cells; " " for any white space.
    decimal: "." or ",". skip: Lines before the table, which are left out. sheet: Sheet of a workbook, or group of
    channels.
    """

    heading: int | None = None
    delimiter: str | None = None
    decimal: str | None = None
    skip: int = 0
    sheet: str | None = None


DETECTED = Dialect()


def dialect_of(
    heading: int | str | None = None,
    delimiter: str | None = None,
    decimal: str | None = None,
    skip: int = 0,
    sheet: str | None = None,
    sign: str = "",
) -> Dialect:
    """Return the dialect of the keys of a source, or of options, which begin with `sign`.

    Raises:
        SourceError: Naming the key that is wrong.
    """
    if isinstance(heading, str) and heading != "none" and not (heading.isdigit() and int(heading)):
        raise SourceError(f"{sign}heading {heading}: is no line; give its number from 1 on, or none")
    line = None if heading is None else 0 if heading == "none" else int(heading)
    delimiter = {"tab": "\t", "space": " "}.get(delimiter or "", delimiter)
    if delimiter is not None and len(delimiter) != 1:
        raise SourceError(f"{sign}delimiter {quoted(delimiter)}: is no single sign; give one, or tab or space")
    if decimal not in (None, ".", ","):
        raise SourceError(f"{sign}decimal {quoted(str(decimal))}: is no decimal sign; give . or ,")
    if skip < 0:
        raise SourceError(f"{sign}skip {skip}: is below 0; give the number of lines before the table")
    return Dialect(line, delimiter, decimal, skip, sheet)


class CsvFormat(NamedTuple):
    """How a CSV is read.

    names: Of its columns. delimiter, decimal, encoding: Of its cells, numbers and text. first: Line after the heading.
    group: Signs between thousands. comment: Begin of lines that are left out. remark: What was assumed, if it is not
    plain. settled: Whether a row was found.
    """

    names: list[str]
    delimiter: str
    decimal: str
    encoding: str
    first: int = 2
    group: str = ""
    comment: str = ""
    remark: str = ""
    settled: bool = False

    def cells(self, lines: Iterable[str]) -> csv.Reader:  # type: ignore[name-defined]
        """Return a reader of the cells of lines."""
        kept = (("\n" if _COMMENT.match(line) else line) for line in lines) if self.comment else lines
        return _reader(kept, self.delimiter)

    def fits(self, cells: Sequence[str]) -> bool:
        """Return whether cells are a row of the table: as many as columns, and blank ones after them."""
        n = len(self.names)
        return len(cells) == n or (len(cells) > n and not any(cell.strip() for cell in cells[n:]))


def _reader(lines: Iterable[str], delimiter: str) -> csv.Reader:  # type: ignore[name-defined]
    if delimiter == " ":
        lines = (line.replace("\t", " ") for line in lines)
    return csv.reader(lines, delimiter=delimiter, skipinitialspace=delimiter == " ")


class _Row(NamedTuple):
    """A row of the head: its first line, the line after it, its cells, and whether it is a comment."""

    line: int
    after: int
    cells: list[str]
    comment: bool = False


@lru_cache(8)
def format_of(path: Path, head: bytes, given: Dialect = DETECTED) -> CsvFormat:
    """Return the format of a CSV that begins with these bytes.

    A table is sought for each delimiter: the last lines give the number of columns and those of numbers and dates, the
    first row that has these follows the heading. The delimiter is that with a heading, and with most numbers and dates.
    Where none is found, the first line is the heading.

    Raises:
        SourceError: If they are not text, or a number may be written with a decimal comma or a separator of thousands.
    """
    refuse_others(path, head)
    encoding = _encoding(head)
    if not encoding.startswith("utf-16") and any(byte < 9 or 13 < byte < 32 for byte in head[:4096]):
        raise SourceError(
            f"{path}:1: it begins with the bytes {head[:8].hex(' ')} and is not text; give a CSV in UTF-8, "
            "or name the file by its format (.parquet, .mat, .npz)"
        )
    lines = io.StringIO(head.decode(encoding, "replace").removeprefix("\ufeff"), newline="").readlines()
    if len(head) == HEAD_BYTES and len(lines) > 2:
        lines.pop()  # It is cut.
    if separator := re.fullmatch(r'"?sep=(.)"?\s*', lines[0] if lines else "", re.IGNORECASE):
        given = given._replace(delimiter=given.delimiter or separator[1], skip=max(given.skip, 1))
    begin, types, rows = (next((k for k, one in enumerate(lines) if mark.match(one)), -1) for mark in _IGNITION)
    if 0 <= begin < types < rows:
        lines[begin], lines[types : rows + 1] = "\n", "\n" * (rows + 1 - types)
    if ends := [k for k, one in enumerate(lines, 1) if one.startswith("***End_of_Header***")][:2]:  # LabVIEW's .lvm
        lines[: ends[-1]] = "\n" * ends[-1]
        lines[ends[-1] :] = [re.sub(r"^(X_Value.*)\WComment\s*$", r"\1\n", one) for one in lines[ends[-1] :]]
    if given.heading and not "".join(lines[given.heading - 1 : given.heading]).strip(f"\r\n{DELIMITERS}"):
        raise SourceError(f"{path}: its heading is to be line {given.heading}, which is blank or not there; correct it")
    first = lines[given.skip] if given.skip < len(lines) else ""
    offered = sorted(DELIMITERS[:-1], key=first.count, reverse=True)
    tables = [_Table(lines, delimiter, given) for delimiter in (given.delimiter or [*offered, " "])]
    best = max(tables, key=lambda table: table.score)
    if not best.score:
        line, delimiter = given.heading or given.skip + 1, tables[0].delimiter
        names = [
            name.strip() for name in next(_reader([one[:HEAD_BYTES] for one in lines[line - 1 : line]], delimiter), [])
        ]
        return CsvFormat(names, delimiter, given.decimal or ".", encoding, line + 1)
    found = best.format(path, encoding)
    return found._replace(first=max(found.first, rows + 2 if begin >= 0 else 0))


_IGNITION = [re.compile(rf'"?#{word}\b') for word in ("NAMES", "TYPES", "ROWS")]
"""Lines before the names, the types and the rows in an export of Ignition; only the names are of the heading."""


def _encoding(head: bytes) -> str:
    """Return UTF-16 by its mark or zeros, UTF-8 if the bytes are, and Windows-1252 otherwise."""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    for encoding, high in (("utf-16-le", head[1:1024:2]), ("utf-16-be", head[:1024:2])):
        if len(high) > 1 and high.count(0) > 0.8 * len(high) and b"\0" not in head[:2].replace(b"\0", b"", 1):
            return encoding
    try:
        head.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 4:  # not merely cut within a character
            return "cp1252"
    return "utf-8-sig"


class _Table:
    """The table that lines hold if their cells are separated by a delimiter; `score` is 0 if they hold none."""

    def __init__(self, lines: Sequence[str], delimiter: str, given: Dialect) -> None:
        self.delimiter, self._given, self._lines = delimiter, given, lines
        self.score = 0.0
        tail = self._rows(max(given.skip, len(lines) - SAMPLE_LINES))
        if sum(row.comment for row in tail) > len(tail) / 2:
            return
        lengths = [len(row.cells) for row in tail if not row.comment and row.cells]
        width, count = max(Counter(n for n in lengths if n > 1).items(), key=lambda item: item[1], default=(0, 0))
        if not count:
            return
        usual = [row.cells for row in tail if len(row.cells) == width and not row.comment]
        shares = [_share(column) for column in zip(*usual)]
        self._width, self._typed = width, [k for k, share in enumerate(shares) if share >= 0.5]
        self._ragged = not any(cells[-1] for cells in usual)  # Each row ends with a delimiter.
        filled = sum(bool(cell) for cells in usual for cell in cells)
        number = sum(_is_typed(cell) for cells in usual for cell in cells)
        if not self._typed or not number or (delimiter == " " and number < filled / 2):
            return  # Words of a text are separated by spaces, too.
        self._all = self._rows(given.skip)
        self._begin = next((k for k, row in enumerate(self._all) if self._is_row(row)), len(self._all))
        if self._begin == len(self._all):
            return
        self._heading, self._block = self._head()
        if self._heading or count > MIN_SHARE * len(lengths):
            self.score = number / filled * count / len(lengths) + bool(self._heading)

    def _rows(self, skip: int) -> list[_Row]:
        """Return the rows of the lines after the first ones; blank lines are rows without cells."""
        found: list[_Row] = []
        k = skip
        while k < len(self._lines):
            line, after = self._lines[k], k + 1
            if comment := _COMMENT.match(line):
                line = line[comment.end() :]
            elif line.count('"') % 2:
                for end in range(k + 2, min(k + 1 + MAX_CELL_LINES, len(self._lines) + 1)):
                    if "".join(self._lines[k:end]).count('"') % 2 == 0:
                        line, after = "".join(self._lines[k:end]), end
                        break
            try:
                cells = [cell.strip() for cell in next(_reader([line], self.delimiter), [])]
            except csv.Error:
                cells = []
            found.append(_Row(k + 1, after + 1, cells if any(cells) else [], bool(comment)))
            k = after
        return found

    def _fits(self, row: _Row) -> bool:
        return len(row.cells) in (self._width, self._width - self._ragged) or (
            len(row.cells) > self._width and not any(row.cells[self._width :])
        )

    def _is_row(self, row: _Row) -> bool:
        """Return whether a row has numbers or dates where the last rows have some."""
        if row.comment or not self._fits(row) or row.line <= (self._given.heading or 0):
            return False
        cells = [row.cells[k] for k in self._typed if k < len(row.cells)]
        return any(map(_is_typed, cells)) and all(_is_typed(cell) or _is_neutral(cell) for cell in cells)

    def _head(self) -> tuple[_Row | None, list[_Row]]:
        """Return the row of the names, and the rows of the heading: names, units, descriptions."""
        before, given = self._all[: self._begin], self._given.heading
        if given is not None:
            block = [row for row in before if row.line >= given and (row.line == given or self._is_text(row))]
            return (block[0], block) if given and block and block[0].cells else (None, [])
        named = [k for k, row in enumerate(before) if self._is_text(row) or (self._fits(row) and _timed(row) == 2)]
        named = [k for k in named if not before[k].comment] or named[-1:]
        if named:
            start = end = named[-1]
            while start - 1 in named or (start and before[start - 1].comment and not before[end].comment):
                start -= 1
            block = [row for row in before[start : end + 1] if row.comment == before[end].comment]
            units = _unit_rows(block)
            offered = [row for row in block if row not in units]
            if self._width == 2:
                offered.reverse()
            return max(offered, key=lambda row: (_timed(row), sum(map(bool, row.cells)))), block
        # Names that are numbers, or one too many or too few, which is reported of each row.
        filled = [row for row in before if row.cells and not row.comment]
        first = next((row for row in self._all if row.cells), None)
        for row in [first] if first in filled and first is not None and self._fits(first) else filled[-1:]:
            near = len(row.cells) > 1 and abs(len(row.cells) - self._width) < 2
            if self._fits(row) or (near and not any(map(_is_typed, row.cells))):
                return row, [row]
        return None, []

    def _is_text(self, row: _Row) -> bool:
        return self._fits(row) and any(row.cells) and not any(map(_is_typed, row.cells))

    def format(self, path: Path, encoding: str) -> CsvFormat:
        """Return the format of the file of this table."""
        given, remarks = self._given, []
        rows = [row for row in self._all[self._begin :] if not row.comment and self._fits(row)]
        if (heading := self._heading) is not None:
            names, first = heading.cells, self._block[-1].after
            while len(names) > 2 and not names[-1] and self._ragged:
                names = names[:-1]
            units = [row for row in _unit_rows(self._block) if row.line > heading.line][:1]
            for row in units:
                cells = [*row.cells, *[""] * len(names)]
                numbers = [any(_NUMBER.fullmatch(one.cells[k]) for one in rows[:SAMPLE_LINES]) for k in self._typed]
                of_numbers = {k for k, number in zip(self._typed, numbers) if number}
                names = [_with_unit(name, cells[k]) if k in of_numbers else name for k, name in enumerate(names)]
            if given.heading is None and (heading.line > given.skip + 1 or units):
                remarks.append(f"heading in line {heading.line}")
            for row in units:
                strange = [cell for cell in row.cells if cell.strip("[]() ") not in NO_UNITS and not _unit_in(cell)]
                unknown = f" (not known: {', '.join(strange)}; give them under `units`)" if strange else ""
                remarks.append(f"units in line {row.line}{unknown}")
        else:
            width = self._width - self._ragged
            names, first = [f"c{k}" for k in range(1, width + 1)], rows[0].line
            if given.heading != 0:
                remarks.append(f"no heading, so columns are named c1 to c{width}")
        decimal, group, lone = _signs(path, rows, self.delimiter, given.decimal)
        comment = next((m[1] for line in self._lines[given.skip :] if (m := _COMMENT.match(line))), "")
        if self.delimiter == " " and given.delimiter is None:
            remarks.append("columns separated by spaces")
        if decimal == "," and given.decimal is None and (remarks or group or self.delimiter == ","):
            remarks.append("decimal comma")
        if lone:
            other = f"give --decimal . (decimal of the source) if it is {lone.replace(',', '')}"
            remarks.append(f"{lone} is taken as {float(lone.replace(',', '.')):g}; {other}")
        if group:
            remarks.append(f"thousands separator {', '.join(map(repr, group))}")
        if comment:
            remarks.append(f"lines that begin with {comment} are comments")
        return CsvFormat(
            names, self.delimiter, decimal, encoding, first, group, comment, ", ".join(remarks), settled=True
        )


_COMMENT = re.compile(r"(#(?![\d,;\t|])|%(?= )|//(?= )) *")  # A name may be #1 or %RH.
_SPACES = " '’\u00a0\u202f"  # Signs between thousands beside point and comma
_EXPONENT = r"(?:[eE][+-]?\d+)?"
_NUMBER = re.compile(
    rf"[+-]?(?:\d{{1,3}}(?:[.,{_SPACES}]\d{{3}})+|\d+)?(?:[.,]\d*)?{_EXPONENT}|nan|[+-]?inf(?:inity)?", re.IGNORECASE
)


@lru_cache(4096)
def _is_typed(cell: str) -> bool:
    """Return whether a cell is a number, a date or a clock."""
    if _NUMBER.fullmatch(cell):
        return any(map(str.isalnum, cell))
    return CLOCK.fullmatch(cell) is not None or layout(cell) is not None or ns_of_iso(cell) is not None


def _is_neutral(cell: str) -> bool:
    """Return whether a cell is blank or a word for a missing value."""
    return cell.lower() in ("", "na", "n/a", "null", "none", "-") or QUALITY_WORD.fullmatch(cell) is not None


def _share(column: Iterable[str]) -> float:
    """Return the share of numbers and dates among the values of a column."""
    cells = [cell for cell in column if not _is_neutral(cell)]
    return sum(map(_is_typed, cells)) / len(cells) if cells else 0.0


def _timed(row: _Row) -> int:
    """Return 2 if a cell of a heading is the usual name of a time, 1 if one is similar to it."""
    names = [cell.lower().partition("[")[0].strip() for cell in row.cells]
    return 2 if set(names) & set(TIME_NAMES) else int(any(map(TIME_NAME.search, names)))


NO_UNITS = ("-", "", "1", "unitless", "TS", "RN")  # TS and RN are those of time and number of a Campbell logger


def _unit_in(cell: str) -> str:
    """Return the unit that a cell of a row of units gives; empty if it gives none."""
    return "" if (text := cell.strip("[]() ")) in NO_UNITS else heading_unit(f"x [{text}]") or ""


def _unit_rows(block: Sequence[_Row]) -> list[_Row]:
    """Return the rows of a heading that hold units, which follow that of the names."""
    found = []
    for row in block[1:]:
        cells = [cell for cell in row.cells if cell]
        share = sum(cell.strip("[]() ") in NO_UNITS or bool(_unit_in(cell)) for cell in cells) / len(cells)
        timed = _timed(row) == 2 > max(_timed(one) for one in block if one.line < row.line)  # a row of names
        if any(map(_unit_in, cells)) and (share == 1.0 or (share >= 0.5 and not timed)):
            found.append(row)
    return found


def _with_unit(name: str, cell: str) -> str:
    unit = _unit_in(cell)
    return f"{name} [{unit}]" if unit and name and heading_unit(name) is None else name


_SPACED = re.compile(rf"[+-]?\d{{1,3}}([{_SPACES}])\d{{3}}(?:\1\d{{3}})*(?:[.,]\d*)?{_EXPONENT}")
_LONE = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")  # 1,234 may be either.
_COMMA = re.compile(rf"[+-]?(?:\d*|\d{{1,3}}(?:[.{_SPACES}]\d{{3}})+),\d+{_EXPONENT}")
_POINTS = re.compile(r"[+-]?\d{1,3}(?:\.\d{3})+,\d+")
_COMMAS = re.compile(r"[+-]?\d{1,3}(?:,\d{3})+\.\d+|[+-]?\d{1,3}(?:,\d{3}){2,}")
_POINT = re.compile(r"[+-]?\d*\.\d+")
_WHOLE = re.compile(r"[+-]?\d{1,3}")
_DOTTED_DATE = re.compile(r"\d{1,2}\.\d{1,2}\.\d{2,4}\b.*")


def _signs(path: Path, rows: Sequence[_Row], delimiter: str, given: str | None) -> tuple[str, str, str]:
    """Return the decimal sign of the numbers, the signs between their thousands, and a number that may be two.

    Raises:
        SourceError: If 1,234 may be 1234 as well as 1.234.
    """
    columns = [dict.fromkeys(column) for column in zip_longest(*(row.cells for row in rows), fillvalue="")]
    cells = [cell for column in columns for cell in column if not cell.isalnum()]

    def some(pattern: re.Pattern[str], among: Iterable[str] = cells) -> bool:
        return any(map(pattern.fullmatch, among))

    lone = next(filter(_LONE.fullmatch, cells), None)
    mixed = [column for column in columns if some(_LONE, column)] if lone else []
    quoted_cells = delimiter == ","  # Beside numbers with a point, such a comma is no decimal sign.
    commas = some(_COMMAS) or any(some(_POINT, column) or (quoted_cells and some(_WHOLE, column)) for column in mixed)
    sure = any(_COMMA.fullmatch(cell) and not _LONE.fullmatch(cell) for cell in cells)
    if quoted_cells and some(_POINT):
        commas, sure = commas or lone is not None, False
    if given is None and lone and delimiter == "," and not (commas or sure or some(_DOTTED_DATE, cells)):
        line = next(row.line for row in rows if lone in row.cells)
        both = f"{lone.replace(',', '')} or {lone.replace(',', '.')}"
        raise SourceError(
            f"{path}:{line}: {quoted(lone)} may be {both}; give --decimal . or --decimal , (decimal of the source)"
        )
    decimal = given or ("," if not commas and (sure or lone) else ".")
    group = dict.fromkeys(found[1] for cell in cells if (found := _SPACED.fullmatch(cell)))
    if (commas or lone) if decimal == "." else some(_POINTS):
        group[",."[decimal == ","]] = None
    return decimal, "".join(group), lone if lone and given is None and decimal == "," and not sure else ""
