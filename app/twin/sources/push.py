"""Sources of messages: those that other programs send, and those of a broker, a server or a device."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from config.channels import ColumnSection
from config.fleet_schema import ASSET_LEVEL, FleetMqttSection, FleetPushSection
from config.source_schema import MqttSourceSection, OpcUaSourceSection, PushSection
from config.yaml_files import Key
from estimators.errors import nearest, shown_name
from estimators.model.state_space import StateSpaceModel
from sources.pieces import VALUES

from ..secrets import secret
from .kind import Kind, Opening, blamed, failure

if TYPE_CHECKING:
    from sources.messages import Messages
    from sources.source import Source

TOPIC_FILTER = re.compile(r"(?:(?:[^#+/\x00]*|\+)/)*(?:[^#+/\x00]*|\+|#)")
"""Topics with wildcards, as brokers take them."""

MessageSection = PushSection | MqttSourceSection | OpcUaSourceSection


def messages_of(opening: Opening, key: str = "", named: Iterable[str] = ()) -> Messages:
    """Return the values of a source; refuse those `named` under `key` that feed nothing."""
    from sources.messages import Messages

    if not opening.live:
        text = (
            "has no recording; record a session (`nisus run TWIN --record FILE.rrd`) and give its file to the command"
        )
        raise failure(opening.loaded, opening.key, text)
    section = replace(opening, section=with_channels(opening.section, opening.model))
    width, report = opening.model.width, opening.report
    assets = isinstance(opening.section, FleetPushSection | FleetMqttSection)
    messages = blamed(section, lambda channels: Messages(channels, width=width, report=report, assets=assets))
    for name in sorted(set(named) - set(messages.names)):
        text = f"names {name!r}, no value of this twin; {nearest(name, messages.names)}"
        raise failure(opening.loaded, (*opening.key, key), text)
    return messages


def _open_mqtt(opening: Opening) -> Source:
    from sources.brokers import SHARED, MqttSource, TopicMap

    section: MqttSourceSection = opening.section
    messages = messages_of(opening, "topics", (name for topic in section.topics.values() for name in topic.values))
    topics: dict[str, TopicMap] = {}
    subscribed: list[str] = []
    by_hand = opening.stored and section.client_id is not None and section.qos > 0
    if by_hand and section.qos == 2:
        rule = "is 2; set it to 1: a fleet with --store takes each of its messages once"
        raise failure(opening.loaded, (*opening.key, "qos"), rule)
    password = _password(opening)
    for name, topic in section.topics.items():
        levels = name.split("/")
        asset = levels.index(ASSET_LEVEL) if isinstance(section, FleetMqttSection) else None
        name = name if asset is None else "/".join([*levels[:asset], "+", *levels[asset + 1 :]])
        if not TOPIC_FILTER.fullmatch(name):
            rule = "+ and # must stand alone between slashes, and # at the end"
            raise failure(opening.loaded, (*opening.key, "topics"), f"names {shown_name(name)}; {rule}")
        if name in topics:
            raise failure(opening.loaded, (*opening.key, "topics"), f"has {name} twice; name each topic once")
        group = 2 if SHARED.match(name) else 0
        topics[name] = TopicMap(**topic.model_dump(), asset=None if asset is None else asset - group)
        if asset is None or not opening.assets:
            subscribed.append(name)
        else:
            own = [item for item in opening.assets if not set(item) & set("+#/")]
            subscribed += ["/".join([*levels[:asset], item, *levels[asset + 1 :]]) for item in own]
    return MqttSource(
        messages,
        section,
        topics,
        qos=section.qos,
        password=password,
        client_id=section.client_id,
        report=opening.report,
        subscribed=subscribed,
        by_hand=by_hand,
    )


def _password(opening: Opening) -> str | None:
    variable, key = opening.section.password_env, (*opening.key, "password_env")
    return None if variable is None else secret(variable, key, opening.loaded.places)


def _check_secrets(opening: Opening) -> None:
    """Report a missing password of a fleet before anything is compiled; commands on recordings of a twin need none."""
    if isinstance(opening.section, FleetMqttSection):
        _password(opening)


def _open_opcua(opening: Opening) -> Source:
    from sources.brokers import OpcUaSource

    section: OpcUaSourceSection = opening.section
    messages = messages_of(opening, "nodes", section.nodes)
    return OpcUaSource(messages, section.url, section.nodes, period=section.every, report=opening.report)


def with_channels(section: MessageSection, model: StateSpaceModel) -> MessageSection:
    """Return a section with its channels; of one without any, all sensors and inputs by their own names."""
    if _sections(section, ()):
        return section
    rows, starts = model.row_names, model.row_start
    sensors = {
        sensor.name: ColumnSection(columns=tuple(rows[start : start + len(sensor.rows)]))
        for sensor, start in zip(model.sensors, starts, strict=True)
    }
    inputs = {item.name: ColumnSection(columns=(item.name,)) for item in model.inputs}
    return section.model_copy(update={"sensors": sensors, "inputs": inputs})


def _sections(section: MessageSection, key: Key) -> dict[Key, Any]:
    return {key: section} if section.sensors or section.inputs or section.truth else {}


def of_messages(open_: Callable[[Opening], Source], files: Callable[[Opening], object] = lambda _: None) -> Kind:
    """Return the kind of a live source of messages, which has no recording."""
    return Kind(open_, sections=_sections, takes_log=False, kernels=(VALUES,), files=files)


PUSH = of_messages(messages_of)
MQTT = of_messages(_open_mqtt, files=_check_secrets)
OPC_UA = of_messages(_open_opcua)
