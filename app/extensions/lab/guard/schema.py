"""Schema of the files that hold recorded figures. The docstring under each field is its documentation."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from config.companion_schema import AcceptedSection
from config.fields import Count, NotNegative, Number, Positive, Section, Text, refused


class FigureSection(Section):
    """One figure of each fold: log by log, and of each log seed by seed."""

    values: Annotated[tuple[Number, ...], Field(min_length=1)]
    """Recorded values."""
    allowed: Annotated[tuple[NotNegative, ...], Field(min_length=1)]
    """Allowed deterioration."""

    @model_validator(mode="after")
    def _alike(self) -> FigureSection:
        if len(self.values) != len(self.allowed):
            text = f"has {len(self.allowed)} entries; values has {len(self.values)}"
            raise refused("relation", text, "allowed")
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
    """Sum of the magnitudes of each log's values, which identifies the log."""
    figures: dict[str, FigureSection]
    """Figures by name."""

    @model_validator(mode="after")
    def _complete(self) -> ReferenceSection:
        folds = len(self.events) * self.seeds
        if len(self.sums) != len(self.events):
            raise refused("relation", f"has {len(self.sums)} entries; events has {len(self.events)}", "sums")
        for name, each in self.figures.items():
            if len(each.values) != folds:
                text = f"has {name} of {len(each.values)} folds; there are {folds}"
                raise refused("relation", text, "figures")
        return self
