"""Times of a table's rows: numbers in a unit, ISO 8601, other dates, and local times of a time zone."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from estimators.errors import SourceError, quoted

from ..units import to_ns

DAY_NS = 86_400 * 10**9

UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1, "min": 60 * 10**9, "h": 3600 * 10**9}
"""Nanoseconds of each unit of time."""

SERIAL_DAYS = {"excel": 25_569, "matlab": 719_529}
"""Units that count days, with the number of 1970-01-01: Excel's serial date and MATLAB's datenum."""

MAX_TIME_NS = 2**62
"""Distance (146 years) of a time from 0; numbers beyond it are of another unit, or no times."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_NAIVE_EPOCH = datetime(1970, 1, 1)

_MONTHS = {name: k for k, name in enumerate("jan feb mar apr may jun jul aug sep oct nov dec".split(), start=1)}

_DATE = re.compile(
    r"(\d{1,4})([./ -])(\d{1,2}|[A-Za-z]{3})\2(\d{2,4})"
    r"(?:[T ,]+(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,9}))?)?(?:\s*([AaPp])\.?[Mm]\.?)?)?"
)
"""25.10.2020 01:00:00, 10/25/2020 1:00 PM, 25-Oct-2020 01:00:00.250, 2020/10/25."""

MAX_DETECTION_CELLS = 4096  # Cells from which the order of day and month is taken


class TimeColumn(NamedTuple):
    """The column that holds the time.

    unit: Of numbers, a key of `UNITS` or `SERIAL_DAYS`. format: Of dates, as in `datetime.strptime`; None detects it.
    zone: Time zone of dates without an offset, for example Europe/Berlin; None is UTC.
    """

    name: str
    unit: str = "s"
    format: str | None = None
    zone: str | None = None


class TimeReader:
    """Converts a time column to nanoseconds, chunk by chunk.

    Raises:
        SourceError: If dates may be day/month as well as month/day, or the zone is unknown.
    """

    def __init__(self, column: TimeColumn) -> None:
        self._column = column
        days = SERIAL_DAYS.get(column.unit)
        self._factor = UNITS[column.unit] if days is None else DAY_NS
        self._origin = days or 0
        self._order: str | None = None
        self._last = -MAX_TIME_NS

    def read(self, cells: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return times (ns), and a mask of the rows that have one.

        Args:
            cells: Cells of a CSV as text, or a column of pyarrow: numbers, timestamps or text.
        """
        if isinstance(cells, list):
            return self._of_cells(cells)
        import pyarrow

        kind = cells.type
        known = ~cells.is_null().to_numpy(zero_copy_only=False)
        if pyarrow.types.is_timestamp(kind) or pyarrow.types.is_date(kind):
            zone = getattr(kind, "tz", None)
            whole = cells.cast(pyarrow.timestamp("ns", zone)).cast(pyarrow.int64())
            t = whole.fill_null(0).to_numpy(zero_copy_only=False)
            return self._local(t, known & (zone is None)), known
        if pyarrow.types.is_integer(kind) and not self._origin:
            whole = cells.cast(pyarrow.int64()).fill_null(0).to_numpy(zero_copy_only=False)
            known = known & (np.abs(whole) <= MAX_TIME_NS // self._factor)
            return np.where(known, whole, 0) * self._factor, known
        if pyarrow.types.is_floating(kind) or pyarrow.types.is_integer(kind):
            numbers = cells.cast(pyarrow.float64()).to_numpy(zero_copy_only=False) - self._origin
            known = known & (np.abs(numbers) <= MAX_TIME_NS / self._factor)
            t = to_ns(np.where(known, numbers, 0.0) * (self._factor / 1e9))
            return (self._local(t, known) if self._origin else t), known
        return self._of_cells([item or "" for item in cells.cast(pyarrow.string()).to_pylist()])

    def is_date(self, cell: str) -> bool:
        """Return whether a cell is a date, day or month first."""
        return self._of_text(cell) is not None or _DATE.fullmatch(cell) is not None

    def _of_cells(self, cells: list[str]) -> tuple[np.ndarray, np.ndarray]:
        if self._order is None and self._column.format is None:
            self._order = _day_and_month(self._column.name, cells)
        t = np.zeros(len(cells), np.int64)
        known, naive = np.zeros((2, len(cells)), np.bool_)
        for k, cell in enumerate(cells):
            found = self._of_text(cell)
            if found is not None and abs(found[0]) <= MAX_TIME_NS:
                (t[k], naive[k]), known[k] = found, True
        return self._local(t, naive), known

    def _of_text(self, text: str) -> tuple[int, bool] | None:
        """Return one cell as ns, and whether that is local time; a number is taken exactly as it is written."""
        if "_" in text:
            return None  # 1_000 is a number in Python only.
        if self._column.format is not None:
            try:
                return _since_epoch(datetime.strptime(text, self._column.format))
            except ValueError:
                return None
        try:
            number = float(text)
        except ValueError:
            return ns_of_iso(text) or self._of_date(text)
        if not np.isfinite(number):
            return None
        return int(((Decimal(text) - self._origin) * self._factor).to_integral_value()), self._origin > 0

    def _of_date(self, text: str) -> tuple[int, bool] | None:
        match = _DATE.fullmatch(text)
        if match is None:
            return None
        first, _, second, third, hour, minute, second_of_minute, fraction, half = match.groups()
        month_first = self._order == "month"
        day, month, year = (second, first, third) if month_first else (first, second, third)
        if len(first) == 4:
            year, month, day = first, second, third
        try:
            when = datetime(
                int(year) + (2000 if len(year) == 2 else 0),
                _MONTHS[month.lower()] if month.isalpha() else int(month),
                int(day),
                int(hour or 0) % (12 if half else 24) + (12 if (half or "").lower() == "p" else 0),
                int(minute or 0),
                int(second_of_minute or 0),
            )
        except (ValueError, KeyError):
            return None
        t, naive = _since_epoch(when)
        return t + int((fraction or "0").ljust(9, "0")), naive

    def _local(self, t: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Return times in UTC; those in the mask `local` are of the zone.

        An hour that comes twice, when the clock is set back, is the first one until times would run backwards.
        """
        if self._column.zone is None or not local.any():
            return t
        import pyarrow
        import pyarrow.compute

        naive = pyarrow.array(t[local], pyarrow.timestamp("ns"))
        first, second = (
            pyarrow.compute.assume_timezone(naive, self._column.zone, ambiguous=which, nonexistent="earliest")
            .cast(pyarrow.int64())
            .to_numpy()
            for which in ("earliest", "latest")
        )
        found = first.copy()
        for k in np.flatnonzero(first != second):
            before = found[k - 1] if k else self._last
            found[k] = first[k] if first[k] >= before else second[k]
        self._last = int(found[-1])
        t = t.copy()
        t[local] = found
        return t


def _since_epoch(when: datetime) -> tuple[int, bool]:
    """Return ns, and whether `when` has no offset."""
    naive = when.tzinfo is None
    delta = when - (_NAIVE_EPOCH if naive else _EPOCH)
    return (delta.days * 86_400 + delta.seconds) * 10**9 + delta.microseconds * 1000, naive


def ns_of_iso(text: str) -> tuple[int, bool] | None:
    """Return an ISO 8601 date as ns, and whether it has no offset."""
    head, dot, tail = text.partition(".")
    digits = len(tail) - len(tail.lstrip("0123456789"))
    fraction, offset = tail[:digits], tail[digits:]
    try:
        t, naive = _since_epoch(datetime.fromisoformat(head + offset))
    except ValueError:
        return None
    return t + (int(fraction[:9].ljust(9, "0")) if dot and fraction else 0), naive


def _day_and_month(name: str, cells: Sequence[str]) -> str:
    """Return which comes first in dates such as 25.10.2020: "day" or "month".

    Raises:
        SourceError: If the cells do not show it.
    """
    unclear = None
    for cell in islice(cells, MAX_DETECTION_CELLS):
        match = _DATE.fullmatch(cell)
        if match is None or len(match[1]) == 4 or not match[3].isdigit() or ns_of_iso(cell):
            continue
        if match[2] == "." or int(match[1]) > 12:
            return "day"
        if int(match[3]) > 12:
            return "month"
        unclear = unclear or cell
    if unclear is None:
        return "day"
    separator = _DATE.fullmatch(unclear)[2]  # type: ignore[index]
    day, month = (separator.join(order) for order in (("%d", "%m", "%Y"), ("%m", "%d", "%Y")))
    clock = " %H:%M:%S" if unclear.count(":") == 2 else " %H:%M" if ":" in unclear else ""
    raise SourceError(
        f"{name} is {quoted(unclear)}, which may be day{separator}month or month{separator}day; set the time's format "
        f'(time.format, --time-format): "{day}{clock}" or "{month}{clock}"'
    )
