"""The schema of recorded scores: what `nisus guard` compares a recording with."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from .fields import Count, NotNegative, Number, Positive, Section, Text
from .tuning_schema import AcceptedSection


class FigureSection(Section):
    """One figure of each fold: log by log, and of each log seed by seed."""

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
    seeds: Count = 1
    """Folds of each log, with other seeds; 1 of a filter that does not draw. Default: 1."""
    span: Positive | None = None
    """Seconds of the recording that were folded. Default: all."""
    events: Annotated[tuple[Count, ...], Field(min_length=1)]
    """Events of each log."""
    sums: Annotated[tuple[NotNegative, ...], Field(min_length=1)]
    """The sum of the sizes of each log's values, which tells one from another."""
    figures: dict[str, FigureSection]
    """What was measured, by name."""

    @model_validator(mode="after")
    def _complete(self) -> ReferenceSection:
        folds = len(self.events) * self.seeds
        if len(self.sums) != len(self.events):
            raise PydanticCustomError(
                "length", "has {n} entries; events has {m}", {"n": len(self.sums), "m": len(self.events), "key": "sums"}
            )
        for name, each in self.figures.items():
            if len(each.values) != folds:
                raise PydanticCustomError(
                    "length",
                    "has {name} of {n} folds; there are {m}",
                    {"name": name, "n": len(each.values), "m": folds, "key": "figures"},
                )
        return self
