"""The schema of a fleet's YAML: a twin, its assets, and the source of their measurements."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from app.extensions.mqtt.schema import ASSET_LEVEL, MqttSection, MqttSourceSection
from config.fields import Count, Duration, DurationOrZero, Number, Section, Text, Texts, refused
from config.output_schema import ReceiverSection
from config.source_schema import PushSection, TableSection
from estimators.errors import is_blank


class FleetTableSection(TableSection):
    """Tables (CSV or Parquet) with the measurements of many assets."""

    asset: Text
    """Column with the name of each row's asset."""


class FleetPushSection(PushSection):
    """Messages with the field `asset`, which other programs send with POST /api/readings."""


class FleetMqttSection(MqttSourceSection):
    """Topics of an MQTT broker, in which `{asset}` stands for the level with the name of the asset."""

    @model_validator(mode="after")
    def _named(self) -> FleetMqttSection:
        for topic in self.topics:
            if topic.split("/").count(ASSET_LEVEL) != 1:
                text = (
                    f"names {topic!r}; one of its levels must be {ASSET_LEVEL}, as in plant/{ASSET_LEVEL}/temperature"
                )
                raise refused("relation", text, "topics")
        return self


class AssetTuningsSection(Section):
    """Values of the tuning that differ from asset to asset; those of the twin hold for the others."""

    file: Text | None = None
    """CSV with a row for each asset, relative to this file. Its columns are `asset` and keys of the tuning, such as
    p.resistance, R.winding or Q.temperature; a unit may follow, as in p.resistance [mOhm]. Default: none."""
    asset: Text = "asset"
    """Column of `file` with the name of each row's asset. Default: asset."""
    values: dict[str, dict[str, Number]] = {}
    """Values by asset and key of the tuning, in its units, for example {pump 3: {p.resistance: 0.5}}; they take
    precedence over `file`. Default: none."""

    @model_validator(mode="after")
    def _some(self) -> AssetTuningsSection:
        if self.file is None and not self.values:
            raise refused("absent", "has neither file nor values; give one of them")
        return self


class FleetAlertSection(Section):
    """A rule for alerts on the health of the assets. Those in alarm at a moment are one message."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")] | None = None
    """Name of the rule. Default: its condition, as in health-degraded."""
    health: Literal["advisory", "suspect", "degraded", "diverged", "stale"]
    """Health from which on an asset is in alarm: degraded includes diverged and stale."""
    after: DurationOrZero = 1.0
    """Seconds for which an asset must be so. Default: 1."""
    clear: DurationOrZero = 10.0
    """Seconds of better health after which an asset has recovered. Default: 10."""
    group: DurationOrZero = 10.0
    """Least seconds between two messages; what changes meanwhile is in the next. Default: 10."""
    repeat: Duration | Literal["never"] = 3600.0
    """Seconds after which a message is repeated while assets are in alarm. Default: 3600."""
    to: Texts | None = None
    """Names of receivers. Default: all."""

    @property
    def title(self) -> str:
        """Name of the rule, or its condition."""
        return self.name or f"health-{self.health}"


class FleetOutputsSection(Section):
    """Publication of the estimates of all assets, and receivers of alerts. Nothing is published by default."""

    every: Duration = 1.0
    """Seconds between two states of an asset that are published, if it has changed. Default: 1."""
    mqtt: MqttSection | None = None
    """MQTT broker to which states are published, {host, port, prefix, ...}; topics are PREFIX/FLEET/ASSET/state.
    Default: none."""
    receivers: dict[Text, ReceiverSection] = {}
    """Receivers of alerts, by name. Default: none."""


class FleetSection(Section):
    """Many assets of one twin."""

    twin: Text
    """Name of a bundled twin, or path to a YAML file, relative to this file. Model, tuning and estimator are its own;
    its source, outputs and faults are not used."""
    assets: Texts | Count | None = None
    """Names of the assets, from which others are refused; or how many there may be, named by the source in the order of
    their first measurements. One more takes the place of an asset that sent a single message, else it is refused.
    Default: 100,000 that senders name, and as many as tables do."""
    tunings: AssetTuningsSection | None = None
    """Values of the tuning by asset: {file, asset, values}. Assets that are named here are listed from the start.
    Default: the twin's for all."""
    late: Annotated[int, Field(strict=True, ge=0, le=4096)] = 8
    """Events of an asset among which a late one is inserted. 0 drops late events, and an asset takes half of the
    memory. Default: 8."""
    source: Annotated[FleetTableSection | FleetPushSection | FleetMqttSection, Field(discriminator="type")]
    """Source of the measurements: its `type` is table, push or mqtt, with the keys of that source in a twin."""
    outputs: FleetOutputsSection = FleetOutputsSection()
    """Where estimates are published, and who receives alerts: {mqtt, receivers}. Default: nowhere but the page."""
    alerts: tuple[FleetAlertSection, ...] = ()
    """Rules for alerts, as in [{health: degraded, after: 60}]. Default: {health: degraded} if there are receivers."""

    @model_validator(mode="after")
    def _once(self) -> FleetSection:
        if isinstance(self.assets, tuple) and len(set(self.assets)) < len(self.assets):
            twice = next(name for name in self.assets if self.assets.count(name) > 1)
            raise refused("relation", f"names {twice!r} twice; name each asset once", "assets")
        if isinstance(self.assets, tuple) and (blank := [name for name in self.assets if is_blank(name)]):
            raise refused("relation", f"names {blank[0]!r}, which is blank; give it a visible name", "assets")
        return self


FleetSection.model_rebuild()  # on import, as the processes of its assets share it
