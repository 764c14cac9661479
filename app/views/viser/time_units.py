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


def unit_for(span: float) -> Unit:
    """The largest unit of which `span` seconds hold three; seconds if they hold none."""
    fitting = [unit for unit in UNITS if span >= MANY * unit.seconds]
    return fitting[-1] if fitting else SECONDS
