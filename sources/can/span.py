"""From when to when a CAN log lasts, without reading it: for a slider that seeks in it."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

import can

from estimators.errors import SourceError

from ..clock import second_ns
from ..reader_process import read_isolated
from .mf4 import mf4_span

SPAN_TIMEOUT_S = 5.0
"""Seconds to wait for the span, which only draws a slider."""

TAIL = 4096
"""Bytes at the end of a text log that hold its last lines."""


def log_span(files: list[Path]) -> tuple[int, int] | None:
    """First and last time of consecutive logs, ns; None where the format does not tell without being read."""
    first, last = _span(files[0]), _span(files[-1])
    return None if first is None or last is None or last[1] < first[0] else (first[0], last[1])


def _span(path: Path) -> tuple[int, int] | None:
    kind = path.suffix.lower()
    try:
        if kind == ".mf4":
            stat = path.stat()
            return _mf4(path, stat.st_mtime_ns, stat.st_size)
        if kind == ".blf":
            with can.BLFReader(path) as reader:
                span = second_ns(reader.start_timestamp), second_ns(reader.stop_timestamp)
            # A logger that was cut off has not written the end.
            return span if span[1] > span[0] > 0 else None
        if kind == ".log":
            return _candump(path)
    except (OSError, ValueError, SourceError):
        # Not known is an answer; what is wrong with the file is reported when it is read.
        return None
    return None


@lru_cache(maxsize=64)
def _mf4(path: Path, stamp: int, size: int) -> tuple[int, int] | None:
    """Kept while the file is unchanged: a replay that is sought back asks again."""
    return next(iter(read_isolated(mf4_span, path, timeout=SPAN_TIMEOUT_S)), None)


def _candump(path: Path) -> tuple[int, int] | None:
    with path.open("rb") as file:
        head = file.read(TAIL)
        file.seek(max(0, path.stat().st_size - TAIL))
        tail = file.read()
    stamp = re.compile(rb"^\((\d+\.\d+)\) ", re.MULTILINE)
    first, last = stamp.search(head), stamp.findall(tail)
    return (second_ns(float(first[1])), second_ns(float(last[-1]))) if first and last else None
