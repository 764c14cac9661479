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
    """Its coloured error, if the twin's sensor has one."""
    use: Annotated[bool, Field(strict=True)] = True
    """false holds the sensor out. Default: true."""


class AcceptedSection(Section):
    """Acceptance of this version as the reference of `nisus guard` and lists."""

    at: Text
    """Time, as 2026-11-22T10:30:00Z."""
    note: str = ""
    """Reason."""


class MovedSection(Section):
    """Result of a fit for one entry, in the entry's unit."""

    before: Number
    """Its value before."""
    after: Number
    """Its value in this version."""
    low: Number | None = None
    """Lower end of the 95 % interval. Default: unbounded."""
    high: Number | None = None
    """Upper end of the 95 % interval. Default: unbounded."""
    sigma: Number = 0.0
    """Change in standard deviations of its estimate, on a logarithmic scale for positive entries."""


class EvidenceSection(Section):
    """Evidence for a proposed version: better prediction of held-out blocks of time."""

    gain: Number
    """Gain in log-likelihood per held-out measurement, nats; for another aim, gain in its score."""
    error: NotNegative
    """Standard error of the gain."""
    before: dict[str, Number] = {}
    """Scores of the previous settings on the held-out blocks; `scores` are those of this version."""
    entries: dict[str, MovedSection] = {}
    """Changed entries, by key."""


class VersionSection(Section):
    """Origin and scores of a tuning version."""

    twin: Text
    """Name of the twin that it was made for."""
    model: Text
    """Name of its model: values mean nothing to another."""
    model_version: Annotated[int, Field(strict=True, ge=0)] = 1
    """Which version of the model it was made for: each maintenance begins another."""
    saved: Text
    """Time, as 2026-11-22T10:30:00Z."""
    note: str = ""
    """Description of the attempt and its result."""
    fitted_on: Annotated[tuple[Text, ...], BeforeValidator(as_list, json_schema_input_type=str | list[str])] = ()
    """The recordings that it was fitted on, or where else it is from."""
    scores: dict[str, Number] = {}
    """Scores on these recordings: nis, log_likelihood (per measurement), rmse.NAME, coverage.NAME, ..."""
    evidence: EvidenceSection | None = None
    """Evidence of the fit that proposed it. Default: not proposed by a fit."""
    accepted: AcceptedSection | None = None
    """Default: not accepted. Of several that are, the last counts."""


class TuningSection(Section):
    """A tuning version: tuned values of a twin. All others are those of the twin's file."""

    version: VersionSection
    """Origin and scores."""
    estimator: Annotated[
        EstimatorSection | None, BeforeValidator(as_estimator, json_schema_input_type=str | EstimatorSection)
    ] = None
    """The filter, with all of its options that are not the catalogue's."""
    filters: dict[str, dict[str, Option]] = {}
    """Options of other filters, by name."""
    parameters: dict[str, Number] = {}
    """Parameters of the model."""
    prior: dict[str, PriorSection] = {}
    """Prior before the first measurement."""
    noise: dict[str, NoiseSection] = {}
    """Process noise Q by name."""
    sensors: dict[str, TunedSensorSection] = {}
    """Sensor noise R by sensor."""
    gate: Annotated[
        GateSection | None, BeforeValidator(as_gate, json_schema_input_type=GateProbability | GateSection | None)
    ] = None
    """The gate; null for none."""
    commissioned: dict[str, NormalSection] = {}
    """Baseline by sensor row, recorded when it was accepted."""


class FigureSection(Section):
    """One figure of each fold: log by log, and of each log seed by seed."""

    values: Annotated[tuple[Number, ...], Field(min_length=1)]
    """Recorded values."""
    allowed: Annotated[tuple[NotNegative, ...], Field(min_length=1)]
    """Allowed deterioration."""

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
    """Figures by name."""

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
