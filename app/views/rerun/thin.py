"""Which rows of a long history to draw: the extremes of every short stretch of time."""

from __future__ import annotations

import numpy as np


def last_of_each_time(t: np.ndarray) -> np.ndarray:
    """Indices of the last row of each distinct time, of times in order."""
    return np.flatnonzero(np.append(t[1:] != t[:-1], np.ones(min(t.size, 1), bool)))


def thin(t: np.ndarray, low: np.ndarray, high: np.ndarray, width: int) -> np.ndarray:
    """Rows to draw, at most two of each stretch of `width` nanoseconds, and the last row of all.

    Args:
        t: Times in order, shape (n,).
        low: The lowest row of each stretch by this is kept, shape (n,); finite.
        high: The highest by this too.
        width: Nanoseconds; zero keeps every row.
    """
    if width <= 0 or t.size <= 2:
        return np.arange(t.size)
    stretch = t // width
    starts = np.flatnonzero(np.append(True, stretch[1:] != stretch[:-1]))
    if 2 * starts.size >= t.size:
        return np.arange(t.size)
    group = np.cumsum(np.append(0, stretch[1:] != stretch[:-1]))
    lowest = _first_of_groups(group, low == np.minimum.reduceat(low, starts)[group])
    highest = _first_of_groups(group, high == np.maximum.reduceat(high, starts)[group])
    return np.unique(np.concatenate((lowest, highest, [t.size - 1])))


def _first_of_groups(group: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Index of the first row of each group in which the mask holds."""
    rows = np.flatnonzero(mask)
    return rows[np.append(True, group[rows[1:]] != group[rows[:-1]])]


def last_of_stretch(t: np.ndarray, width: int) -> np.ndarray:
    """Indices of the last row of each stretch of `width` nanoseconds, of times in order."""
    return last_of_each_time(t // width if width > 0 else t)
