"""Sections of the YAML: topics of an MQTT broker as source, and a broker as output and receiver of alerts."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from config.channels import MessagesSection
from config.fields import EnvironmentName, Host, Port, Section, Text, as_list

ASSET_LEVEL = "{asset}"
"""Level of a topic that is the name of the asset, in the source of a fleet."""


class TopicSection(Section):
    """Payloads of one MQTT topic, as JSON. Paths are dotted: data.level, or items.0.v; "" is the whole payload."""

    values: dict[Text, str] = {}
    """Path of each value by its name. Default: the payload is a message as of POST /api/readings."""
    time: Text | None = None
    """Path of the time: ISO 8601, or a number. Default: the time of arrival."""
    unit: Literal["s", "ms", "us", "ns"] = "ns"
    """Unit of a time in numbers, since 1970. Default: ns."""
    quality: Text | None = None
    """Path of the quality of the values. Default: none, all are good."""
    good: Annotated[tuple[Text, ...], BeforeValidator(lambda value: [str(item) for item in as_list(value) or []])] = (
        "Good",
        "good",
        "GOOD",
        "192",
        "True",
    )
    """Qualities of good values; with any other the values are missing. Default: Good, 192 and true."""
    sequence: Text | None = None
    """Path of a sequence number: a message of the same topic and number is taken once. Default: none."""


def _topic(value: object) -> object:
    return {"values": {value: ""}} if isinstance(value, str) else {} if value is None else value


class BrokerSection(Section):
    """An MQTT broker."""

    host: Host
    """Name or address of the broker."""
    port: Port = 1883
    """Its port. Default: 1883; 8883 is usual with TLS."""
    user: Text | None = None
    """User name. Default: none."""
    password_env: EnvironmentName | None = None
    """Environment variable with the password. Default: none."""
    ca_file: Text | None = None
    """Certificate of the authority that signed the broker's, for TLS. Default: none, no encryption."""


class MqttSourceSection(BrokerSection, MessagesSection):
    """Topics of an MQTT broker."""

    type: Literal["mqtt"]
    """mqtt"""
    topics: Annotated[
        dict[
            Text,
            Annotated[TopicSection, BeforeValidator(_topic, json_schema_input_type=str | TopicSection | None)],
        ],
        Field(min_length=1),
    ]
    """Topics, + and # included, and their payloads: the name of a value, {plant/LT101: LT101}, if the payload is a
    number; {values, time, quality, ...} if it is JSON; null if it is a message as of POST /api/readings."""
    qos: Annotated[int, Field(strict=True, ge=0, le=2)] = 1
    """Quality of service. Default: 1."""
    client_id: Text | None = None
    """Name of the session, under which the broker keeps messages while the twin is away. Default: none, it does not."""


class MqttSection(BrokerSection):
    """Publication of the state at an MQTT broker, under the topics PREFIX/TWIN/state, birth, status and alert."""

    prefix: Annotated[str, Field(pattern=r"^[^+#\x00]+$")] = "nisus"
    """First part of the topics. Default: nisus."""


class MqttReceiverSection(Section):
    """A receiver of alerts: the broker of `outputs.mqtt`, under the topic PREFIX/TWIN/alert."""

    type: Literal["mqtt"]
    """mqtt"""
