"""Format times of a log, durations and counts."""

from __future__ import annotations

import time

FIRST_DATED_NS = 10**18  # nanoseconds since 1970 from which on a time has a date: those of this century


def format_time(t: int) -> str:
    """Format a time of the log (ns): with its date if it has one, else in seconds."""
    if t < FIRST_DATED_NS:
        return f"{t * 1e-9:.6g} s"
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(t // 10**9))


def duration_text(seconds: float) -> str:
    """Return a time in the largest unit of which there are two."""
    units = ((86400.0, "days"), (3600.0, "h"), (60.0, "min"))
    size, unit = next((entry for entry in units if seconds >= 2.0 * entry[0]), (1.0, "s"))
    return f"{seconds / size:.3g} {unit}"


def counted(number: int, noun: str) -> str:
    """Return a number of things: `1 reading`, `1,200 readings`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
