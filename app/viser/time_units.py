"""The unit of a time axis, chosen by its span: seconds for ten seconds, days for a fortnight."""

from __future__ import annotations

from dataclasses import dataclass

MANY = 3.0
"""So many of a unit at least are shown on an axis in that unit."""


@dataclass(frozen=True)
class Unit:
    """A unit of time, and with how many digits after the point it tells a moment."""

    name: str
    seconds: float
    digits: int

    def text(self, seconds: float) -> str:
        """A moment in this unit."""
        return f"{seconds / self.seconds:.{self.digits}f} {self.name}"


SECONDS = Unit("s", 1.0, 1)
UNITS = (SECONDS, Unit("min", 60.0, 2), Unit("h", 3600.0, 3), Unit("d", 86400.0, 4))


def unit_for(span: float, present: Unit = SECONDS) -> Unit:
    """The unit of an axis over `span` seconds, if it has been in the `present` one so far.

    A larger unit comes when the span holds three of it, the smaller one comes back when it does not hold one: a span
    that grows, or that varies a little, changes the unit seldom and never to and fro.
    """
    fitting = [unit for unit in UNITS if span >= MANY * unit.seconds]
    best = fitting[-1] if fitting else SECONDS
    return best if best.seconds > present.seconds or span < present.seconds else present


def window_name(window: float) -> str:
    """A length of time for people, in the largest unit of which it is three or more, and a round number."""
    whole = [unit for unit in UNITS if window >= MANY * unit.seconds and window % unit.seconds == 0.0]
    unit = whole[-1] if whole else SECONDS
    return f"{window / unit.seconds:g} {unit.name}"
