"""A check as plain text."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from ..present.export.parts import Part

WIDTH = 118

SHORT = 12
"""Characters up to which a cell is a value."""


def as_text(parts: Sequence[Part]) -> list[str]:
    """Lines of the page; a table whose rows do not fit is a paragraph for each row."""
    lines: list[str] = []
    for part in parts:
        lines += ["", part.title] if lines else [part.title]
        for said in part.said:
            lines += textwrap.wrap(said, WIDTH, initial_indent="  ", subsequent_indent="    ")
        lines += _table(part)
    return lines


def _table(part: Part) -> list[str]:
    widths = [max(len(cell) for cell in column) for column in zip(part.head, *part.rows, strict=True)]
    if sum(widths) + 2 * len(widths) > WIDTH + 40:
        return _paragraphs(part)
    rows = (part.head, *part.rows) if part.rows else ()
    return [
        ("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))).rstrip() for row in rows
    ]


def _paragraphs(part: Part) -> list[str]:
    lines = []
    for row in part.rows:
        first, second, *others = row
        lines.append(f"  {first} {second}".rstrip())
        # What is short means nothing without its head, and what is a sentence needs none.
        cells = [*zip(part.head[2:], others, strict=True)]
        short = [f"{head} {cell}".strip() for head, cell in cells if cell not in ("", "-") and len(cell) <= SHORT]
        for other in [", ".join(short), *(cell for _, cell in cells if len(cell) > SHORT)]:
            lines += textwrap.wrap(other, WIDTH, initial_indent="      ", subsequent_indent="      ")
    return lines
