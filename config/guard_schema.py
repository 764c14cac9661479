"""The schema of recorded scores: what `nisus guard` compares a recording with."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from .fields import Count, Flag, NotNegative, Number, Positive, Section, Text
from .tuning_schema import AcceptedSection


class FigureSection(Section):
    """One figure, of each fold."""

    values: Annotated[tuple[Number, ...], Field(min_length=1)]
    """What it was."""
    allowed: Annotated[tuple[NotNegative, ...], Field(min_length=1)]
    """By how much it may be worse."""

    @model_validator(mode="after")
    def _alike(self) -> FigureSection:
        if len(self.values) != len(self.allowed):
            raise PydanticCustomError(
                "length",
                "has {n} entries; values has {m}",
                {"n": len(self.allowed), "m": len(self.values), "key": "allowed"},
            )
        return self


class ReferenceSection(Section):
    """The recorded scores of one recording."""

    accepted: AcceptedSection
    """When they were recorded, and why."""
    version: Text
    """The tuning version that was folded with."""
    estimator: Text
    """Its filter."""
    draws: Flag
    """Whether its estimate depends on a seed: the folds are then those of several seeds."""
    span: Positive | None = None
    """Seconds of the recording that were folded. Default: all."""
    events: Annotated[tuple[Count, ...], Field(min_length=1)]
    """Events of each fold's log."""
    sums: Annotated[tuple[NotNegative, ...], Field(min_length=1)]
    """The sum of the sizes of all their values, which tells one log from another."""
    figures: dict[str, FigureSection]
    """What was measured, by name."""
