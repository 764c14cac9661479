"""Results described once: topics of sentences, figures and tables, rendered as terminal text, HTML or JSON."""

from __future__ import annotations

import dataclasses
import json
import math
import textwrap
import time
from collections.abc import Mapping, Sequence
from html import escape
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from estimators.errors import digits

WORSE = "worse than no filter"
"""Text that HTML shows in red."""

WIDTH = 118
"""Columns of wrapped text."""

MAX_TABLE_WIDTH = WIDTH + 40
"""Columns of a table; each row of a wider one becomes a paragraph."""

MIN_LAST_WIDTH = 40
"""Columns to which a long last cell is wrapped at least."""

SHORT_CELL = 12
"""Characters up to which a cell in a paragraph needs the heading of its column."""

NO_WRAP = 24
"""Characters up to which a cell in HTML stays on one line."""

Cell: TypeAlias = str | float | None
"""Content of a table cell; None and NaN mean that there is no value."""


class TableColumn(NamedTuple):
    """Heading of a table column, and the format of its numbers.

    Numbers have three significant digits, or `decimals` digits after the point. `scale` multiplies them first: 100 for
    a share shown in percent. `absent` replaces None and NaN.
    """

    title: str
    decimals: int | None = None
    scale: float = 1.0
    absent: str = "-"

    def text(self, value: Cell) -> str:
        """Return a cell as text."""
        return number_text(value, self.decimals, self.scale, self.absent)


class Figure(NamedTuple):
    """Named value with its unit and an optional remark."""

    name: str
    value: Cell
    unit: str = ""
    remark: str = ""
    decimals: int | None = None

    def text(self) -> str:
        """Return value, unit and remark."""
        shown = f"{number_text(self.value, self.decimals)} {self.unit}".rstrip()
        return f"{shown}   {self.remark}" if self.remark else shown


class Bar(NamedTuple):
    """Two lengths to compare, in `unit`: 2 σ and the protection level, or an RMS and that of the open loop."""

    name: str
    unit: str
    first: float
    second: float


class Topic(NamedTuple):
    """One topic of a result: a title, sentences, then a list of figures and one table.

    `marks` rates the second cell of each row ("good", "partly", "bad" or ""). HTML adds `html`, draws `bars` with
    their `legend`, and prints `notes` in small type at the end.
    """

    title: str
    sentences: tuple[str, ...] = ()
    columns: tuple[TableColumn | str, ...] = ()
    rows: tuple[tuple[Cell, ...], ...] = ()
    bars: tuple[Bar, ...] = ()
    legend: tuple[str, str] = ("", "")
    marks: tuple[str, ...] = ()
    html: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()

    @property
    def headings(self) -> list[str]:
        """Titles of the columns."""
        return [column if isinstance(column, str) else column.title for column in self.columns]

    def cells(self) -> list[list[str]]:
        """Return the rows as text, without the headings."""
        columns = [TableColumn(column) if isinstance(column, str) else column for column in self.columns]
        return [[column.text(cell) for column, cell in zip(columns, row, strict=True)] for row in self.rows]

    def is_numeric(self, k: int) -> bool:
        """Return whether column k holds numbers, which are aligned to the right."""
        column = [row[k] for row in self.rows if row[k] not in (None, "", "-")]
        return bool(column) and not any(isinstance(cell, str) for cell in column)


def number_text(value: Cell, decimals: int | None = None, scale: float = 1.0, absent: str = "-") -> str:
    """Return a number as text: integers in full, others with three significant digits or so many decimals."""
    if value is None or (isinstance(value, (float, np.floating)) and np.isnan(value)):
        return absent
    if isinstance(value, str):
        return value
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if isinstance(value, (int, np.integer)) and scale == 1.0:
        return f"{value:,}"
    return digits(scale * value) if decimals is None else f"{scale * value:,.{decimals}f}"


def finite_text(value: float) -> str:
    """Return a number as text with three significant digits; a dash if it is infinite or unknown."""
    return digits(value) if np.isfinite(value) else "-"


def plain(value: Any, *, infinity_text: bool = False) -> Any:
    """Return a copy that JSON can hold.

    Named tuples and dataclasses become objects, arrays and tuples lists, NaN null, and infinity null or "inf".
    """
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item, infinity_text=infinity_text) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, infinity_text=infinity_text) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value) if infinity_text and math.isinf(value) else None
    return value


def to_json(value: Any) -> str:
    """Return any nest of results as one line of strict JSON; see `plain`."""
    return json.dumps(plain(value), allow_nan=False)


def to_text(topics: Sequence[Topic]) -> str:
    """Return the topics as text, one blank line between them."""
    lines: list[str] = []
    for topic in topics:
        lines += ["", topic.title] if lines else [topic.title]
        for sentence in topic.sentences:
            lines += textwrap.wrap(sentence, WIDTH, initial_indent="  ", subsequent_indent="    ")
        width = max((len(figure.name) for figure in topic.figures), default=0)
        lines += [f"  {figure.name:<{width}}  {figure.text()}" for figure in topic.figures]
        lines += _table_lines(topic)
    return "\n".join(lines)


def _table_lines(topic: Topic) -> list[str]:
    table = [topic.headings, *topic.cells()]
    if len(table) == 1:
        return []
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    before_last = 2 * len(widths) + sum(widths[:-1])
    if before_last + min(widths[-1], MIN_LAST_WIDTH) > MAX_TABLE_WIDTH:
        return _paragraphs(topic)
    right = [topic.is_numeric(k) for k in range(len(widths))]
    lines = []
    for row in table:
        cells = [
            cell.rjust(width) if numeric else cell.ljust(width)
            for cell, width, numeric in zip(row, widths, right, strict=True)
        ]
        # A long last cell continues below itself.
        first, *more = textwrap.wrap(cells[-1].rstrip(), MAX_TABLE_WIDTH - before_last) or [""]
        first = cells[-1] if not more else first
        lines.append(f"  {'  '.join([*cells[:-1], first])}".rstrip())
        lines += [" " * before_last + text for text in more]
    return lines


def _paragraphs(topic: Topic) -> list[str]:
    lines = []
    for row in topic.cells():
        first, second, *others = row
        lines.append(f"  {first} {second}".rstrip())
        # A short value needs the heading of its column, a sentence does not.
        cells = [*zip(topic.headings[2:], others, strict=True)]
        short = [f"{head} {cell}".strip() for head, cell in cells if cell not in ("", "-") and len(cell) <= SHORT_CELL]
        for text in [", ".join(short), *(cell for _, cell in cells if len(cell) > SHORT_CELL)]:
            lines += textwrap.wrap(text, WIDTH, initial_indent="      ", subsequent_indent="      ")
    return lines


POLICY = "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data:"
"""Of HTML results: scripts and styles in the file, nothing from elsewhere."""

STYLE = """
@page { size: A4; margin: 14mm }
body { font: 14px/1.45 system-ui, sans-serif; color: #1f2937; background: #fff; max-width: 62em; margin: 2em auto;
       padding: 0 1.5em }
h1 { font-size: 1.5em; margin: 0 0 .2em } h2 { font-size: 1.1em; margin: 1.8em 0 .4em; break-after: avoid }
p { margin: .3em 0 }
table { border-collapse: collapse; width: 100%; font-size: .9em; font-variant-numeric: tabular-nums }
th, td { text-align: left; vertical-align: top; padding: .35em .7em .35em 0; border-bottom: 1px solid #e5e7eb }
th { color: #6b7280; font-weight: 500 }
tr, svg { break-inside: avoid }
.good { color: #15803d } .partly { color: #b45309 } .bad { color: #b91c1c }
.good, .partly, .bad { font-weight: 600 }
.short { white-space: nowrap }
.worse { color: #b91c1c }
svg { display: block; margin: .6em 0; max-width: 100%; height: auto }
.small { color: #6b7280; font-size: .85em }
@media print { body { font-size: 10.5px; max-width: none; margin: 0; padding: 0 } }
"""

ROW_PX, NAMES_PX, BAR_PX = 34, 150, 420
"""Height of a pair of bars, width of the names, length of the longest bar."""

BAR_COLORS = "#2563eb", "#f59e0b"
RED_CLASS = ' class="worse"'


def to_html(title: str, topics: Sequence[Topic], *, now: float | None = None) -> str:
    """Return one HTML page that needs no other file; its security policy forbids to load anything.

    The first topic is the head of the page. `now` is the time of writing, s since 1970, UTC; None means now.
    """
    head, *others = topics
    body = [f"<h1>{escape(head.title)}</h1>", *_sentences(head), f'<p class="small">{escape(stamp(now))}</p>']
    body += _content(head)
    for topic in others:
        body += [f"<h2>{escape(topic.title)}</h2>", *_sentences(topic), *_content(topic)]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def stamp(now: float | None = None) -> str:
    """Return the version of Nisus and the time of writing."""
    try:
        own = f" {version('nisus')}"
    except PackageNotFoundError:
        own = ""
    return f"Nisus{own}, {time.strftime('%d %B %Y, %H:%M UTC', time.gmtime(now))}"


def _sentences(topic: Topic) -> list[str]:
    return [f"<p{RED_CLASS if WORSE in text else ''}>{escape(text)}</p>" for text in topic.sentences]


def _content(topic: Topic) -> list[str]:
    body = list(topic.html)
    if any(np.isfinite(bar.first) or np.isfinite(bar.second) for bar in topic.bars):
        body.append(_bars(topic.bars, topic.legend))
    if topic.figures:
        body.append(_html_table([], [((figure.name, figure.text()), "") for figure in topic.figures]))
    if topic.rows:
        marks = topic.marks or ("",) * len(topic.rows)
        body.append(_html_table(topic.headings, [*zip(topic.cells(), marks, strict=True)]))
    return body + [f'<p class="small">{escape(note)}</p>' for note in topic.notes]


def _html_table(headings: Sequence[str], rows: Sequence[tuple[Sequence[str], str]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in headings)
    lines = "\n".join(
        "<tr>" + "".join(_html_cell(cell, mark if k == 1 else "") for k, cell in enumerate(row)) + "</tr>"
        for row, mark in rows
    )
    return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{lines}\n</tbody>\n</table>"


def _html_cell(text: str, mark: str = "") -> str:
    kinds = [mark, "short" if len(text) <= NO_WRAP else "", "worse" if WORSE in text else ""]
    named = " ".join(filter(None, kinds))
    return f'<td class="{named}">{escape(text)}</td>' if named else f"<td>{escape(text)}</td>"


def _bars(bars: Sequence[Bar], legend: tuple[str, str]) -> str:
    """Return two bars a row, each row to its own scale because units differ."""
    width, height = NAMES_PX + BAR_PX + 130, ROW_PX * len(bars) + 24
    lines = [
        f'<svg viewBox="0 0 {width} {height}" width="{width}" font-size="12" '
        f'role="img" aria-label="{escape(legend[0])} beside {escape(legend[1])}">'
    ]
    for k, (color, text) in enumerate(zip(BAR_COLORS, legend, strict=True)):
        x = NAMES_PX + 210 * k
        lines.append(f'<rect x="{x}" y="3" width="10" height="10" fill="{color}"/>')
        lines.append(f'<text x="{x + 15}" y="12">{escape(text)}</text>')
    for k, bar in enumerate(bars):
        top = 24 + ROW_PX * k
        lines.append(f'<text x="{NAMES_PX - 10}" y="{top + 17}" text-anchor="end">{escape(bar.name)}</text>')
        longest = max((value for value in (bar.first, bar.second) if np.isfinite(value)), default=0.0)
        for y, value, color in ((top, bar.first, BAR_COLORS[0]), (top + 12, bar.second, BAR_COLORS[1])):
            finite = bool(np.isfinite(value))
            length = BAR_PX * value / longest if finite and longest > 0.0 else 0.0
            unit = "" if bar.unit == "1" else f" {bar.unit}"
            text = f"{digits(value)}{unit}" if finite else "no number"
            lines.append(f'<rect x="{NAMES_PX}" y="{y}" width="{length:.1f}" height="10" fill="{color}"/>')
            lines.append(f'<text x="{NAMES_PX + length + 6:.1f}" y="{y + 9}">{escape(text)}</text>')
    return "\n".join([*lines, "</svg>"])
