"""Sections as one HTML file: no script, nothing from elsewhere, light, printable."""

from __future__ import annotations

import time
from collections.abc import Sequence
from html import escape
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from estimators.diagnostics.sensitivity.words import digits

from .parts import WORSE, Bar, Part

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

ROW, LEFT, LONG = 34, 150, 420
"""Pixels: height of a pair of bars, width of the names, length of the longest bar."""

SHORT = 24
"""Characters of a cell up to which it stands in one line."""

FIRST, SECOND = "#2563eb", "#f59e0b"


def as_html(title: str, parts: Sequence[Part], *, now: float | None = None) -> str:
    """The whole page; the first part is its head.

    Args:
        title: Of the file.
        parts: From top to bottom.
        now: When it was made, s since 1970, UTC; None is now.
    """
    head, *others = parts
    body = [f"<h1>{escape(head.title)}</h1>", *_said(head), f'<p class="small">{escape(stamp(now))}</p>']
    body += _filled(head)
    for part in others:
        body += [f"<h2>{escape(part.title)}</h2>", *_said(part), *_filled(part)]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def stamp(now: float | None = None) -> str:
    """With which version, and when."""
    try:
        own = f" {version('nisus')}"
    except PackageNotFoundError:
        own = ""
    return f"Nisus{own}, {time.strftime('%d %B %Y, %H:%M UTC', time.gmtime(now))}"


def _filled(part: Part) -> list[str]:
    body = list(part.drawn)
    if any(np.isfinite(bar.first) or np.isfinite(bar.second) for bar in part.bars):
        body.append(_bars(part.bars, part.legend))
    if part.rows:
        body.append(_table(part))
    return body + [f'<p class="small">{escape(said)}</p>' for said in part.small]


def _said(part: Part) -> list[str]:
    return [f"<p{_worse(said)}>{escape(said)}</p>" for said in part.said]


def _worse(text: str) -> str:
    return ' class="worse"' if WORSE in text else ""


def _table(part: Part) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in part.head)
    marks = part.marks or ("",) * len(part.rows)
    rows = "\n".join(
        "<tr>" + "".join(_cell(cell, mark if k == 1 else "") for k, cell in enumerate(row)) + "</tr>"
        for row, mark in zip(part.rows, marks, strict=True)
    )
    return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>"


def _cell(text: str, mark: str = "") -> str:
    kinds = [mark, "short" if len(text) <= SHORT else "", "worse" if WORSE in text else ""]
    named = " ".join(filter(None, kinds))
    return f'<td class="{named}">{escape(text)}</td>' if named else f"<td>{escape(text)}</td>"


def _bars(bars: Sequence[Bar], legend: tuple[str, str]) -> str:
    """Two bars a row, each row to its own scale: their units differ."""
    width, height = LEFT + LONG + 130, ROW * len(bars) + 24
    drawn = [
        f'<svg viewBox="0 0 {width} {height}" width="{width}" font-size="12" '
        f'role="img" aria-label="{escape(legend[0])} beside {escape(legend[1])}">'
    ]
    for k, (color, text) in enumerate(zip((FIRST, SECOND), legend, strict=True)):
        x = LEFT + 210 * k
        drawn.append(f'<rect x="{x}" y="3" width="10" height="10" fill="{color}"/>')
        drawn.append(f'<text x="{x + 15}" y="12">{escape(text)}</text>')
    for k, bar in enumerate(bars):
        top = 24 + ROW * k
        drawn.append(f'<text x="{LEFT - 10}" y="{top + 17}" text-anchor="end">{escape(bar.name)}</text>')
        longest = max((value for value in (bar.first, bar.second) if np.isfinite(value)), default=0.0)
        for y, value, color in ((top, bar.first, FIRST), (top + 12, bar.second, SECOND)):
            finite = bool(np.isfinite(value))
            length = LONG * value / longest if finite and longest > 0.0 else 0.0
            unit = "" if bar.unit == "1" else f" {bar.unit}"
            text = f"{digits(value)}{unit}" if finite else "no number"
            drawn.append(f'<rect x="{LEFT}" y="{y}" width="{length:.1f}" height="10" fill="{color}"/>')
            drawn.append(f'<text x="{LEFT + length + 6:.1f}" y="{y + 9}">{escape(text)}</text>')
    return "\n".join([*drawn, "</svg>"])
