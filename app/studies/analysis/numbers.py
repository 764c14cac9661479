"""Numbers as JSON has them: no NaN and no infinity, and no more digits than mean anything."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def number(value: Any, digits: int = 6) -> float | None:
    """A number of so many digits, or None where it is none."""
    value = float(value)
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None


def listed(values: np.ndarray, digits: int = 6) -> list[Any]:
    """An array as lists of such numbers."""
    return [listed(row, digits) if np.ndim(row) else number(row, digits) for row in values]
