"""Changes of a simulated asset while it runs: its true parameters become others than they were."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

NEVER = 2**62
"""ns: later than any event."""


@dataclass
class Change:
    """A true parameter that is multiplied by `factor` from `start` until `end`, ns of the asset's own time."""

    parameter: str
    factor: float
    start: int
    end: int


@runtime_checkable
class Changeable(Protocol):
    """A simulated asset whose true parameters can be changed while it runs; from any thread.

    `live` False says that its time is that of its events.
    """

    live: bool

    def change(self, parameter: str, factor: float, start: int | None = None, length: int | None = None) -> Change:
        """Multiply a parameter for `length` ns, or for ever, from `start` on (ns), or with the next step.

        Raises:
            SourceError: If there is no such parameter.
        """

    def end(self, change: Change) -> None:
        """End a change with the next step."""
