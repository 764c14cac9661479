"""Frames of CAN logs as columns, and names of buses and ids."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimators.errors import SourceError

from ..formats import suffix_of

EXTENDED = 1 << 31
"""Added to the arbitration id of an extended frame, so that one number identifies it."""

CHUNK_FRAMES = 8192
"""Frames of a chunk."""

BusName = int | str | None


class Raw(NamedTuple):
    """Frames of a log, not decoded.

    Columns of one length n: times (ns), ids (EXTENDED added to extended ones), positions of their buses in `buses`,
    lengths, and bytes (n, longest). `total` counts all frames read for them, wanted or not.
    """

    t: np.ndarray
    key: np.ndarray
    bus: np.ndarray
    length: np.ndarray
    data: np.ndarray
    buses: tuple[BusName, ...]
    total: int


class LogSummary(NamedTuple):
    """Summary after a file's last frames: data frames by bus and id, error frames, and damage."""

    seen: dict[tuple[BusName, int], int]
    errors: int
    fault: str


def unreadable(path: Path, reason: object) -> SourceError:
    """Return the error of a file of which nothing can be read."""
    gist = " ".join(str(reason).split())[:160] or type(reason).__name__
    return SourceError(f"{path}: it cannot be read as {suffix_of(path)[1:].upper()} ({gist}); check that it is one")
