"""Remarks about a recording as a whole go to standard error too, besides being counted and shown."""

from __future__ import annotations

from collections.abc import Callable

from sources.source import NEVER, TRUNCATED, WRONG_TIME
from sources.tables.order import REMARKS as ORDER

from ..intake import CLOCK_MOVED
from ..terminal import complain

REMARKS = (*ORDER, NEVER, TRUNCATED, CLOCK_MOVED)

FIRST = (WRONG_TIME,)
"""Of these only the first is said: there may be as many as there are rows."""


def remarking(report: Callable[[str, str], None]) -> Callable[[str, str], None]:
    """A report that also says each remark, once."""
    said: set[str] = set()

    def both(key: str, text: str) -> None:
        if key in REMARKS and text not in said:
            said.add(text)
            complain(text)
        elif key in FIRST and key not in said:
            said.add(key)
            complain(text)
        report(key, text)

    return both
