"""What every effect of a fault offers, and the moment at which it acts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from .item import Item


@dataclass(frozen=True)
class Moment:
    """Of one event: whether the fault lasts when it is measured, whether it draws, and ns since the fault began."""

    during: bool
    draws: bool
    since: int

    @property
    def seconds(self) -> float:
        """Since the fault began."""
        return self.since / 1e9


class Effect(Protocol):
    """What a fault makes of the events of its target, in the order in which they come."""

    lost: int
    """Events that it swallowed."""

    def apply(self, item: Item, moment: Moment) -> list[Item]:
        """What comes in place of one event."""

    def turn(self, item: Item, moment: Moment) -> list[Item]:
        """What comes when the fault begins or ends, before the event with which it does."""

    def flush(self) -> list[Item]:
        """What it still keeps back when there is no more."""
