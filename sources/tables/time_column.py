"""The time column of a table as nanoseconds."""

from __future__ import annotations

from datetime import UTC, datetime
from decimal import Decimal
from typing import Any

import numpy as np

from ..clock import to_ns

UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1, "min": 60 * 10**9, "h": 3600 * 10**9}

FARTHEST = 2**62
"""Nanoseconds (146 years) that a time may lie from 0; seconds that lie farther off are milliseconds, or no times."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def _of_text(text: str, unit: int) -> int | None:
    """One cell as ns: a number in the unit, exactly as it is written, or a date; None if it is neither."""
    if "_" in text:
        return None  # 1_000 is a number in a program only.
    try:
        number = float(text)
    except ValueError:
        return _of_date(text)
    if not np.isfinite(number):
        return None
    time = int((Decimal(text) * unit).to_integral_value())
    return time if abs(time) <= FARTHEST else None


def _of_date(text: str) -> int | None:
    """ISO 8601 as ns; without a zone it is UTC."""
    head, dot, tail = text.partition(".")
    digits = len(tail) - len(tail.lstrip("0123456789"))
    fraction, zone = tail[:digits], tail[digits:]
    try:
        when = datetime.fromisoformat(head + zone)
    except ValueError:
        return None
    if when.tzinfo is None:
        when = when.replace(tzinfo=UTC)
    delta = when - _EPOCH
    seconds = delta.days * 86400 + delta.seconds
    return seconds * 10**9 + delta.microseconds * 1000 + (int(fraction[:9].ljust(9, "0")) if dot and fraction else 0)


def column_ns(column: Any, unit: str) -> tuple[np.ndarray, np.ndarray]:
    """Times of a column in ns, and a mask of the rows that have one.

    Args:
        column: Cells of a CSV as text, or a column of Parquet: numbers, timestamps or text.
        unit: Unit of numbers: a key of `UNITS`.
    """
    factor = UNITS[unit]
    if isinstance(column, list):
        return _of_cells(column, factor)
    import pyarrow

    kind = column.type
    known = ~column.is_null().to_numpy(zero_copy_only=False)
    if pyarrow.types.is_timestamp(kind) or pyarrow.types.is_date(kind):
        whole = column.cast(pyarrow.timestamp("ns", getattr(kind, "tz", None))).cast(pyarrow.int64())
        return whole.fill_null(0).to_numpy(zero_copy_only=False), known
    if pyarrow.types.is_integer(kind):
        whole = column.cast(pyarrow.int64()).fill_null(0).to_numpy(zero_copy_only=False)
        known = known & (np.abs(whole) <= FARTHEST // factor)
        return np.where(known, whole, 0) * factor, known
    if pyarrow.types.is_floating(kind):
        numbers = column.cast(pyarrow.float64()).to_numpy(zero_copy_only=False)
        known = known & (np.abs(numbers) <= FARTHEST / factor)
        return to_ns(np.where(known, numbers, 0.0) * (factor / 1e9)), known
    return _of_cells([item or "" for item in column.cast(pyarrow.string()).to_pylist()], factor)


def _of_cells(cells: list[str], factor: int) -> tuple[np.ndarray, np.ndarray]:
    times = [_of_text(cell, factor) for cell in cells]
    known = np.array([t is not None for t in times], np.bool_)
    return np.array([0 if t is None else t for t in times], np.int64), known
