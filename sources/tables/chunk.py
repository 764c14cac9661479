"""A few thousand rows of a table, as its reader gives them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

CHUNK = 4096
"""Rows of a chunk, at most."""

Problem = Callable[[str, int, str], None]
"""problem(key, line or row number, text)."""


class Chunk(NamedTuple):
    """Rows of a table: the raw time column, and the values (n, columns) with masks of what is blank.

    `line` is the line (CSV) or row (of the others) of each, counted from 1.
    """

    line: np.ndarray
    time: Any
    values: np.ndarray
    blank: np.ndarray
