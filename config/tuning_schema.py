"""The schema of a tuning version: a YAML of its own beside the twin's.

The docstring under each field is its documentation.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from .fields import (
    Count,
    ErrorSection,
    NoiseSection,
    NotNegative,
    Number,
    Option,
    Positive,
    Section,
    SpreadSection,
    Text,
    as_list,
)
from .schema import EstimatorSection, GateProbability, GateSection, NormalSection, PriorSection, as_estimator, as_gate


class TunedSensorSection(SpreadSection):
    """The noise of one sensor, and whether the estimate uses it. Its limits stay the twin's."""

    error: ErrorSection | None = None
    """Its error that lasts, where the twin's sensor has one."""
    use: Annotated[bool, Field(strict=True)] = True
    """false holds the sensor out. Default: true."""


class AcceptedSection(Section):
    """That this version is the one that guards and lists go by."""

    at: Text
    """When, as 2026-11-22T10:30:00Z."""
    note: str = ""
    """Why."""


class MovedSection(Section):
    """What a fit found of one entry, in the entry's unit."""

    before: Number
    """Its value before."""
    after: Number
    """Its value in this version."""
    low: Number | None = None
    """Where the 95 % interval begins. Default: without bound."""
    high: Number | None = None
    """Where it ends. Default: without bound."""
    sigma: Number = 0.0
    """By how many standard deviations of its estimate it moved, on the logarithm of what is positive."""


class EvidenceSection(Section):
    """Why a fit proposed this version: what it predicts better of the blocks of time that were held out."""

    gain: Number
    """Log-likelihood of a reading there, more than before, nats; of another aim, its score."""
    error: NotNegative
    """Standard error of that."""
    before: dict[str, Number] = {}
    """What the settings before were worth there; `scores` are those after."""
    entries: dict[str, MovedSection] = {}
    """What moved, by key."""


class VersionSection(Section):
    """What a tuning version is of, and what it was worth."""

    twin: Text
    """Name of the twin that it was made for."""
    model: Text
    """Name of its model: values mean nothing to another."""
    model_version: Annotated[int, Field(strict=True, ge=0)] = 1
    """Which version of the model it was made for: each maintenance begins another."""
    saved: Text
    """When, as 2026-11-22T10:30:00Z."""
    note: str = ""
    """What was tried, and what came of it."""
    fitted_on: Annotated[tuple[Text, ...], BeforeValidator(as_list, json_schema_input_type=str | list[str])] = ()
    """The recordings that it was fitted on, or where else it is from."""
    scores: dict[str, Number] = {}
    """What it was worth there: nis, log_likelihood (of a reading), rmse.NAME, coverage.NAME, ..."""
    evidence: EvidenceSection | None = None
    """Why it was proposed. Default: nothing proposed it."""
    accepted: AcceptedSection | None = None
    """Default: not accepted. Of several that are, the last counts."""


class TuningSection(Section):
    """A tuning version: what of a twin was tuned. What it does not say is as the twin's file says."""

    version: VersionSection
    """What it is of."""
    estimator: Annotated[
        EstimatorSection | None, BeforeValidator(as_estimator, json_schema_input_type=str | EstimatorSection)
    ] = None
    """The filter, with all of its options that are not the catalogue's."""
    filters: dict[str, dict[str, Option]] = {}
    """Options of other filters, by name."""
    parameters: dict[str, Number] = {}
    """Parameters of the model."""
    prior: dict[str, PriorSection] = {}
    """The belief before the first reading."""
    noise: dict[str, NoiseSection] = {}
    """Process noise Q by name."""
    sensors: dict[str, TunedSensorSection] = {}
    """Sensor noise R by sensor."""
    gate: Annotated[
        GateSection | None, BeforeValidator(as_gate, json_schema_input_type=GateProbability | GateSection | None)
    ] = None
    """The gate; null for none."""
    commissioned: dict[str, NormalSection] = {}
    """What was normal when it was accepted, by sensor row."""


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
