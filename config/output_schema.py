"""Sections of a twin's YAML about its outputs: where the estimate is published, who is alerted, and when."""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, create_model, model_validator

from .extensions import registered, schemas
from .fields import Duration, DurationOrZero, Number, Positive, Section, Text, Texts, one_of, refused


class AnyReceiver(Section):
    """A receiver of alerts, by the type of an extension."""

    type: Text
    """Name of the type."""


if TYPE_CHECKING:
    ReceiverSection = AnyReceiver
else:
    found = tuple(schemas("receivers").values())
    ReceiverSection = Annotated[reduce(or_, found), Field(discriminator="type")] if found else AnyReceiver


class AlertSection(Section):
    """A rule for alerts: exactly one of health, episode, nis, state and lost."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")] | None = None
    """Name of the rule. Default: its condition, as in health-suspect."""
    health: Literal["advisory", "suspect", "degraded", "diverged", "stale"] | None = None
    """Health from which on there is an alert: suspect includes degraded, diverged and stale."""
    episode: Texts | None = None
    """Causes of episodes, as in [stuck, silent]; all for every cause. Each episode is an alert of its own."""
    nis: Positive | None = None
    """Mean NIS per degree of freedom of the last window above which there is an alert; 1 is expected."""
    state: Text | None = None
    """A state whose estimate is compared with `above` or `below`."""
    above: Number | None = None
    """Upper limit of the state, in its unit."""
    below: Number | None = None
    """Lower limit of the state, in its unit."""
    probability: Annotated[float, Field(strict=True, gt=0, lt=1)] = 0.5
    """Probability that the state is beyond its limit from which on there is an alert, from its mean and standard
    deviation. Default: 0.5, when the mean is beyond; 0.05 warns earlier, 0.95 when it is certain."""
    lost: Duration | None = None
    """Seconds without any event, or in which the fold does not answer, after which there is an alert."""
    after: DurationOrZero = 1.0
    """Seconds for which the condition must last. Default: 1."""
    clear: DurationOrZero = 10.0
    """Seconds without the condition after which the alert is resolved. Default: 10."""
    repeat: Duration | Literal["never"] = 3600.0
    """Seconds after which an alert that lasts is sent again. Default: 3600."""
    maintenance: DurationOrZero = 600.0
    """Seconds after a maintenance in which nothing is sent. Default: 600."""
    to: Texts | None = None
    """Names of receivers. Default: all."""

    @model_validator(mode="after")
    def _one(self) -> AlertSection:
        one_of(self, "health", "episode", "nis", "state", "lost", required=True)
        one_of(self, "above", "below", required=self.state is not None)
        if self.state is None:
            for key in ("above", "below", "probability"):
                if key in self.model_fields_set:
                    raise refused("relation", "belongs to a limit of a state; give the state too", key)
        return self

    @property
    def title(self) -> str:
        """Name of the rule, or its condition."""
        if self.name is not None:
            return self.name
        if self.state is not None:
            return f"{self.state}-{'above' if self.above is not None else 'below'}"
        if self.health is not None:
            return f"health-{self.health}"
        return "episode" if self.episode is not None else "nis" if self.nis is not None else "lost"


class PublishedSection(Section):
    """How often the state is published, and what of it."""

    every: DurationOrZero = 0.1
    """Seconds between two states that are published; 0 publishes after each batch of measurements. Default: 0.1."""
    covariance: Annotated[bool, Field(strict=True)] = False
    """Whether published messages have the covariance of all states. Default: false."""


if TYPE_CHECKING:
    Outputs = PublishedSection
else:
    Outputs = create_model(
        "WithExtensions",
        __base__=PublishedSection,
        **{
            key: (schema | None, Field(None, description=registered("outputs")[key][1].text))
            for key, schema in schemas("outputs").items()
        },
    )


class OutputsSection(Outputs):
    """Publication of the estimate, and receivers of alerts. Nothing is published by default."""

    receivers: dict[Text, ReceiverSection] = {}
    """Receivers of alerts, by name. Default: none."""
