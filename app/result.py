"""Results described once: topics of sentences, figures and tables; `app.render` makes them text or HTML."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from estimators.errors import digits

WORSE = "worse than no filter"
"""Text that HTML shows in red."""

Cell: TypeAlias = str | float | None
"""Content of a table cell; None and NaN mean that there is no value."""

JsonObject: TypeAlias = dict[str, Any]
"""Object of JSON: text, numbers, lists and objects by name."""


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

    def cut(self, most: int, remark: str = "") -> Topic:
        """Return the topic with at most `most` rows, and one with the number of the rest and a remark."""
        left = len(self.rows) - most
        if left <= 1:
            return self
        rows = (*self.rows[:most], (f"... and {left} more{remark}", *[""] * (len(self.columns) - 1)))
        return self._replace(rows=rows, marks=(*self.marks[:most], "") if self.marks else ())

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


def plain(value: object, *, infinity_text: bool = False) -> Any:
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


def to_json(value: object) -> str:
    """Return any nest of results as one line of strict JSON; see `plain`."""
    return json.dumps(plain(value), allow_nan=False)
