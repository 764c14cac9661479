"""Which of the messages that a twin needs a live bus gives: those that do not come are named once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from ..source import NEVER, Report
from .frames import EXTENDED, BusName
from .unseen import Expected, shown_id

if TYPE_CHECKING:
    from .decoder import Decoder

PATIENCE = 5.0
"""Seconds after which a message is missed, or so many of its periods:"""

PERIODS = 3.0

MANY = 20
"""Frames of a message after which a signal is missed that a multiplexer may bring seldom."""


class Heard:
    """Watches what comes until every message has come, or its absence has been reported."""

    def __init__(self, name: str, decoder: Decoder, clock: Callable[[], float], report: Report) -> None:
        """Watch from now on; `name` begins each line, `clock` gives seconds."""
        self._name, self._decoder, self._clock, self._report = name, decoder, clock, report
        self._seen: Counter[tuple[BusName, int]] = Counter()
        self._since = self._next = clock()
        self._told: set[int] = set()
        self._silence_told = False
        self._done = False

    def note(self, messages: Iterable[Any]) -> None:
        """These messages came since the last call; call it when none did, too."""
        if self._done:
            return
        now = self._clock()
        for message in messages:
            if not message.is_error_frame and not message.is_remote_frame:
                if not self._seen:
                    # A bus that only now begins to speak: each message has its time from here.
                    self._since = now
                key = message.arbitration_id | EXTENDED if message.is_extended_id else message.arbitration_id
                self._seen[message.channel, key] += 1
        waited = now - self._since
        if waited >= PATIENCE and now >= self._next:
            self._next = now + 1.0
            self._look(waited)

    def _look(self, waited: float) -> None:
        waiting = [item for item in self._decoder.expected if item.key not in self._told]
        if not self._seen:
            if not self._silence_told:
                self._silence_told = True
                self._report(NEVER, self._silence(waiting))
            return
        left = False
        for item in waiting:
            texts = self._decoder.missing(item, self._seen, least=MANY)
            if not texts or waited < PERIODS * item.period:
                left = True
                continue
            self._told.add(item.key)
            for text in texts:
                self._report(NEVER, f"{self._name}: after {waited:.0f} s {text}")
        self._done = not left

    def _silence(self, waiting: list[Expected]) -> str:
        named = ", ".join(f"{item.name} ({shown_id(item.key)})" for item in waiting[:4])
        more = ", ..." if len(waiting) > 4 else ""
        return (
            f"{self._name}: none of {named}{more} came in {PATIENCE:g} s; check interface, channel and bit rate, "
            "and the ids in the DBC"
        )
