"""Sections of tables, as a check or a report has them: printed as text, or as HTML."""

from __future__ import annotations

from typing import NamedTuple

WORSE = "worse than no filter"


class Bar(NamedTuple):
    """Two lengths to compare, in `unit`: 2 σ and the integrity bound, or an RMS and the open loop's."""

    name: str
    unit: str
    first: float
    second: float


class Part(NamedTuple):
    """One section: a title, what is said before the table, its head and rows; `bars` are what HTML draws of it.

    `marks` are of its rows: whether the second cell says something good, partly so, or bad; "" if nothing. `drawn` are
    charts as SVG, and `small` is said beneath everything: both in HTML alone.
    """

    title: str
    said: tuple[str, ...]
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    bars: tuple[Bar, ...] = ()
    legend: tuple[str, str] = ("", "")
    marks: tuple[str, ...] = ()
    drawn: tuple[str, ...] = ()
    small: tuple[str, ...] = ()
