"""A source that is open and has said nothing yet: the twin waits, and after a while says so."""

from __future__ import annotations

import time
from collections.abc import Callable

from estimators.track import STALE, WAITING

from .notices import Notices


class Silence:
    """From the opening of the source to the first of its events."""

    def __init__(self, notices: Notices, stale_after: float, clock: Callable[[], float] = time.monotonic) -> None:
        """`stale_after`: seconds after which a live source that says nothing is stale; `clock` gives seconds."""
        self._notices, self._after, self._clock = notices, stale_after, clock
        self._since = clock()
        self._told = False

    @property
    def health(self) -> int:
        """Of a twin that has heard nothing."""
        return STALE if self._told else WAITING

    @property
    def cause(self) -> str:
        """Why the twin is stale that has heard nothing; nothing while it waits."""
        if not self._told:
            return ""
        return f"nothing has come since the twin started, {self._clock() - self._since:.0f} s ago; check the source"

    def look(self, *, live: bool) -> None:
        """Nothing has come yet. A recording may be held; of a bus that is silent so long people are told, once."""
        if live and not self._told and self._clock() - self._since > self._after:
            self._told = True
            text = f"stale: nothing has come since the twin started, {self._after:g} s ago; check the source"
            self._notices.say(text, level="warn")

    def broken(self) -> None:
        """Something has come."""
        if self._told:
            self._told = False
            silent = self._clock() - self._since
            self._notices.say(f"the source speaks, {silent:.0f} s after the twin started")
