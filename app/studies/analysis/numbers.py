"""Rounded numbers for JSON, without NaN and infinity."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def number(value: Any, digits: int = 6) -> float | None:
    """Round to so many significant digits; None if it is not finite."""
    value = float(value)
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None


def listed(values: np.ndarray, digits: int = 6) -> list[Any]:
    """Return an array as nested lists of rounded numbers."""
    return [listed(row, digits) if np.ndim(row) else number(row, digits) for row in values]
