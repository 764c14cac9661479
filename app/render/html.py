"""Results as one HTML page."""

from __future__ import annotations

import time
from collections.abc import Sequence
from html import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from string import Template

import numpy as np

from estimators.errors import digits

from ..result import WORSE, Bar, Topic

NO_WRAP = 24
"""Characters up to which a cell stays on one line."""

PAGE = Template(Path(__file__).with_name("result.html").read_text(encoding="utf-8"))
"""Scripts and styles are in the file; its security policy forbids to load anything from elsewhere."""

ROW_PX, NAMES_PX, BAR_PX = 34, 150, 420
"""Height of a pair of bars, width of the names, length of the longest bar."""

BAR_COLORS = "#2563eb", "#f59e0b"
RED_CLASS = ' class="worse"'


def to_html(title: str, topics: Sequence[Topic], *, now: float | None = None) -> str:
    """Return one HTML page that needs no other file.

    The first topic is the head of the page. `now` is the time of writing, s since 1970, UTC; None means now.
    """
    head, *others = topics
    body = [f"<h1>{escape(head.title)}</h1>", *_sentences(head), f'<p class="small">{escape(stamp(now))}</p>']
    body += _content(head)
    for topic in others:
        body += [f"<h2>{escape(topic.title)}</h2>", *_sentences(topic), *_content(topic)]
    return PAGE.substitute(title=escape(title), body="\n".join(body))


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
