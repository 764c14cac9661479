"""A mistake that is made on purpose, and what the twin should say of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import nan
from typing import TYPE_CHECKING

from estimators.diagnostics.episodes import Episode

if TYPE_CHECKING:
    from sources.faults.fault import Fault

ANYBODY: frozenset[str] = frozenset()
"""Subjects of a mistake that no sensor in particular is to be blamed for."""


@dataclass(frozen=True)
class Mistake:
    """One row of the matrix.

    `belief` are factors on entries of the tuning, from the start of the log; `fault` makes the faults of the source for
    a window (start, end) in seconds of the log. An episode has the right cause if its key is among `causes`, and the
    right subject if whom it tells a user to look at (`told.accused`), or the sensor whose row that is, is among
    `subjects`. A mistake without causes is none that should be heard of.

    `size` in `unit`: of a mistake that adds a constant to a sensor or an input, for those who compare. `shifts`:
    whether it moves the means of the innovations alone, by as much in every log; else it changes their noise, or what
    comes when.
    """

    name: str
    causes: frozenset[str]
    subjects: frozenset[str] = ANYBODY
    belief: Mapping[str, float] = field(default_factory=dict)
    fault: Callable[[float, float], list[Fault]] | None = None
    of_asset: bool = False
    size: float = nan
    unit: str = ""
    shifts: bool = False

    def right_cause(self, episode: Episode) -> bool:
        """Whether the cause that an episode names is one of this mistake's."""
        return episode.cause in self.causes

    def right_subject(self, name: str) -> bool:
        """Whether who is to blame by that name, a sensor or one of its rows, is one of this mistake's."""
        return not self.subjects or not self.subjects.isdisjoint((name, name.partition(".")[0]))
