"""Schemas of files beside a twin's YAML: tuning versions. The docstring under each field is its documentation."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator, Field

from .fields import (
    ErrorSection,
    NoiseSection,
    NotNegative,
    Number,
    Option,
    Positive,
    Section,
    SpreadSection,
    Text,
    Validity,
    as_list,
)
from .schema import AS_ESTIMATOR, EstimatorSection, Gate, NormalSection, Parameters, PriorSection


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
    estimator: Annotated[EstimatorSection | None, AS_ESTIMATOR] = None
    """The filter, with all of its options that are not the catalogue's."""
    filters: dict[str, dict[str, Option]] = {}
    """Options of other filters, by name."""
    parameters: Parameters = {}
    """Parameters of the model, with the covariance that the fit gives them: std and correlation."""
    valid_range: dict[str, Validity] = {}
    """Range of the fitted recordings, by state or input, outside which parameters widen."""
    withhold: dict[str, Positive] = {}
    """Half-width of the 95 % band of a state beyond which its estimate is withheld."""
    prior: dict[str, PriorSection] = {}
    """Prior before the first measurement."""
    noise: dict[str, NoiseSection] = {}
    """Process noise Q by name."""
    sensors: dict[str, TunedSensorSection] = {}
    """Sensor noise R by sensor."""
    gate: Gate = None
    """The gate; null for none."""
    baseline: dict[str, NormalSection] = {}
    """Baseline by sensor row, recorded when it was accepted."""
