"""Results as text for a terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from ..result import Topic

WIDTH = 118
"""Columns of wrapped text."""

MAX_TABLE_WIDTH = WIDTH + 40
"""Columns of a table; each row of a wider one becomes a paragraph."""

MIN_LAST_WIDTH = 40
"""Columns to which a long last cell is wrapped at least."""

SHORT_CELL = 12
"""Characters up to which a cell in a paragraph needs the heading of its column."""


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
