"""Source of messages from an MQTT broker, which may go and come back."""

from __future__ import annotations

import base64
import json
import queue
import re
import threading
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING, Any

import numpy as np

from app.result import JsonObject
from app.twin.secrets import secret
from app.twin.sources.kind import Opening, failure
from app.twin.sources.push import messages_of
from estimators.errors import printable, quoted, shown_name
from sources.messages import LATEST, MAX_WAITING, NO_BROKER, REFUSED, REFUSED_MESSAGE, REFUSED_TOPIC, Messages
from sources.source import Numbers, Report, Source
from sources.tables.text import no_value

from .client import mqtt_client
from .schema import ASSET_LEVEL, MqttSourceSection, TopicSection

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessage
    from paho.mqtt.reasoncodes import ReasonCode

TOPIC_FILTER = re.compile(r"(?:(?:[^#+/\x00]*|\+)/)*(?:[^#+/\x00]*|\+|#)")
"""Topics with wildcards, as brokers take them."""

SHARED = re.compile(r"^\$share/[^/]+/")
"""Begins the filter of a shared subscription, but not the topics of its messages."""

UNITS = {"s": 10**9, "ms": 10**6, "us": 1000, "ns": 1}
"""Nanoseconds of the units of a time."""

MAX_PAYLOAD_BYTES = 64 * 1024
"""Largest payload of a topic; a message takes a hundred bytes."""

WINDOW = 32_767
"""Messages of QoS 1 that a broker sends before the first is acknowledged. A store is written several times for as many,
and a packet id, of which there are 65,535, is never in use twice."""

MAX_TOPICS = 500
"""Topics of one request to subscribe."""

MAX_BATCH = 20_000
"""Messages that are decoded at once."""

NO_EXPIRY_S = 2**32 - 1
"""Expiry of a session of MQTT 5 that is kept until the broker's own limit."""


class TopicMap(TopicSection):
    """Location of the values in the payloads of a topic, and the topic level that names the asset."""

    asset: int | None = None
    """Level of the topic with the name of the asset, counted from 0. Default: none."""

    def message(self, topic: str, payload: bytes) -> JsonObject:
        """Return the message of a payload.

        Raises:
            ValueError: If it has none, with the reason.
        """
        if len(payload) > MAX_PAYLOAD_BYTES:
            raise ValueError(f"the payload has {len(payload):,} bytes; at most {MAX_PAYLOAD_BYTES:,} are read")
        try:
            # NaN is no JSON; who sends it has no value.
            body = json.loads(payload, parse_constant=lambda _: None)
        except (ValueError, RecursionError):
            body = payload.decode(errors="replace")
            if not no_value("", body):
                raise ValueError("the payload is no JSON and no number") from None
        asset = {} if self.asset is None else {"asset": topic.split("/")[self.asset]}
        if not self.values:
            if not isinstance(body, dict):
                raise ValueError('the payload must be an object such as {"values": {"NAME": 1.2}}')
            return {"source": topic, **body, **asset}
        good = self.quality is None or str(at_path(body, self.quality)) in self.good
        found: JsonObject = {
            "source": topic,
            "values": {name: at_path(body, path) if good else None for name, path in self.values.items()},
            **asset,
        }
        if self.time is not None:
            found["time"] = as_time(at_path(body, self.time), self.unit)
        if self.sequence is not None:
            found["sequence"] = at_path(body, self.sequence)
        return found


def at_path(body: Any, path: str) -> Any:
    """Return the value at a dotted path of JSON; lists are indexed by number.

    Raises:
        ValueError: If there is none.
    """
    for part in filter(None, path.split(".")):
        try:
            body = body[int(part)] if isinstance(body, list) else body[part]
        except (KeyError, IndexError, TypeError, ValueError):
            raise ValueError(f"the payload has no {quoted(path)}") from None
    return body


def as_time(value: object, unit: str) -> object:
    """Return a number of a unit as ns; a text as it is, which must be ISO 8601."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return value
    try:
        ns = int(Decimal(str(value)) * UNITS[unit])
    except (InvalidOperation, OverflowError, ValueError):
        return value
    return max(-LATEST, min(ns, LATEST))


class TakenPackets:
    """Packets of QoS 1 by id, each until the broker uses its id again, to recognise those that are sent again.

    A broker sends a packet again with its id and the mark of a duplicate if it got no acknowledgement. It may also have
    got it, and used the id for another packet that never arrived: that has another checksum.
    """

    def __init__(self) -> None:
        self._checksums: dict[int, int] = {}

    def add(self, packet: MQTTMessage) -> bool:
        """Note a packet; return whether it is new."""
        checksum = zlib.crc32(packet.payload, zlib.crc32(packet.topic.encode()))
        if packet.dup and self._checksums.get(packet.mid) == checksum:
            return False
        self._checksums[packet.mid] = checksum
        return True

    def state(self) -> str:
        """Return ids and checksums as text, for `restore`."""
        return base64.b64encode(np.array([*self._checksums.items()], "<u4").tobytes()).decode()

    def restore(self, state: str) -> None:
        """Take over the `state` of another."""
        pairs = np.frombuffer(base64.b64decode(state), "<u4").reshape(-1, 2)
        self._checksums = dict(pairs.tolist())


class MqttSource:
    """Live source of the topics of an MQTT broker; payloads are decoded in the thread that reads."""

    live = utc = True

    def __init__(
        self,
        messages: Messages,
        section: MqttSourceSection,
        topics: Mapping[str, TopicMap],
        *,
        password: str | None,
        report: Report,
        subscribed: Sequence[str] | None = None,
        by_hand: bool = False,
    ) -> None:
        """Connect in a thread of its own; a broker that is not there is waited for.

        Args:
            messages: Takes the messages.
            section: The broker. With a `client_id`, it keeps messages of QoS 1 while the twin is away.
            topics: By filter, which may have the wildcards + and #.
            password: Of the user.
            report: Receives lost connections and payloads that cannot be read.
            subscribed: Filters to subscribe to in place of those of `topics`, of which each is a part.
            by_hand: Acknowledge messages once they have been stored, see `Acknowledging`; connect after `restore`.
        """
        self.messages, self._report = messages, report
        self.now = messages.now
        self._subscribed_to = [*topics] if subscribed is None else [*subscribed]
        self._place, self._section = f"{section.host}:{section.port}", section
        own = section.client_id
        self._client = mqtt_client(section, password, client_id=own or "", persistent=own is not None, by_hand=by_hand)
        self._client.on_connect, self._client.on_disconnect = self._connected, self._disconnected
        self._client.on_connect_fail = lambda *_: self._lost("it does not answer")
        for name, topic in topics.items():
            self._client.message_callback_add(SHARED.sub("", name), self._callback(topic))
        self.connected = threading.Event()
        """Set while the topics are subscribed to."""
        self._client.on_subscribe = self._subscribed
        self._requests: dict[int | None, list[str]] = {}
        self._waiting: queue.SimpleQueue[tuple[TopicMap, MQTTMessage]] = queue.SimpleQueue()
        self._by_hand, self._packets = by_hand, TakenPackets()
        self._unstored: dict[int, None] = {}
        """Ids of packets that were read, but not acknowledged, in their order."""
        if not by_hand:
            self._connect()

    def _connect(self) -> None:
        host, port = self._section.host, self._section.port
        if self._by_hand:
            from paho.mqtt.packettypes import PacketTypes
            from paho.mqtt.properties import Properties

            kept = Properties(PacketTypes.CONNECT)
            kept.SessionExpiryInterval, kept.ReceiveMaximum = NO_EXPIRY_S, WINDOW
            self._client.connect_async(host, port, keepalive=15, clean_start=False, properties=kept)
        else:
            self._client.connect_async(host, port, keepalive=15)
        self._client.loop_start()

    def _connected(self, client: Client, _data: object, _flags: object, reason: ReasonCode, *_: object) -> None:
        if reason.is_failure:
            self._lost(f"it refuses: {reason}")
            return
        self._requests.clear()
        for at in range(0, len(self._subscribed_to), MAX_TOPICS):
            names = self._subscribed_to[at : at + MAX_TOPICS]
            self._requests[client.subscribe([(name, self._section.qos) for name in names])[1]] = names

    def _subscribed(self, _client: object, _data: object, number: int, reasons: list[ReasonCode], *_: object) -> None:
        for name, reason in zip(self._requests.pop(number, self._subscribed_to), reasons, strict=False):
            if reason.is_failure:
                text = f"the broker at {self._place} refuses the topic {name} ({reason}); check the rights of the user"
                self._report(REFUSED_TOPIC, text)
        if not self._requests:
            self.connected.set()

    def _disconnected(self, _client: object, _data: object, _flags: object, reason: object, *_: object) -> None:
        self._lost(f"the connection ended: {reason}")

    def _lost(self, why: str) -> None:
        self.connected.clear()
        self._report(
            NO_BROKER, f"no measurements from the broker at {self._place}: {printable(why)}; it is tried again"
        )

    def _callback(self, topic: TopicMap) -> Callable[..., None]:
        def arrived(client: Client, _data: object, packet: MQTTMessage) -> None:
            if self._waiting.qsize() < MAX_WAITING:
                self._waiting.put((topic, packet))
                return
            if self._by_hand and packet.qos:
                client.ack(packet.mid, packet.qos)
            self._refuse(packet, "too many messages wait")

        return arrived

    def read(self, timeout: float) -> Any:
        """Return the events of the next messages."""
        found: list[tuple[TopicMap, MQTTMessage]] = []
        with suppress(queue.Empty):
            found.append(self._waiting.get(timeout=timeout))
            while len(found) < MAX_BATCH:
                found.append(self._waiting.get_nowait())
        decoded = [item for item in found if self._is_new(item[1])]
        pairs = [(packet, message) for topic, packet in decoded if (message := self._decoded(topic, packet))]
        answers = self.messages.send([message for _, message in pairs]) if pairs else []
        for (packet, _), answer in zip(pairs, answers, strict=True):
            if answer.status == REFUSED:
                self._refuse(packet, answer.reason)
        return self.messages.read(0.0)

    def _is_new(self, packet: MQTTMessage) -> bool:
        """Return whether a packet is used; one that was stored before is acknowledged again."""
        if not self._by_hand or not packet.qos:
            return True
        if self._packets.add(packet):
            self._unstored[packet.mid] = None
            return True
        if packet.mid not in self._unstored:
            self._client.ack(packet.mid, packet.qos)
        return False

    def _decoded(self, topic: TopicMap, packet: MQTTMessage) -> JsonObject | None:
        """Return the message of a packet; None if it has none."""
        try:
            found = topic.message(packet.topic, packet.payload)
        except Exception as error:  # noqa: BLE001  no payload may end the source
            self._refuse(packet, str(error))
            return None
        # The broker sends the last retained message to each new subscriber: without a time it is of no moment.
        return None if packet.retain and found.get("time") is None else found

    def _refuse(self, packet: MQTTMessage, reason: str) -> None:
        self._report(REFUSED_MESSAGE, f"{printable(packet.topic)[:100]}: {printable(reason)}; it is not used")

    @property
    def mark(self) -> int:
        """Messages that were accepted and read."""
        return self.messages.mark

    def numbers(self, mark: int) -> JsonObject:
        """See `Marked`."""
        numbers = self.messages.numbers(mark)
        return {"senders": numbers, "packets": self._packets.state()} if self._by_hand else numbers

    def restore(self, numbers: Numbers) -> None:
        """See `Marked`."""
        self.messages.restore(numbers.get("senders", {}) if self._by_hand else numbers)
        if self._by_hand:
            self._packets.restore(numbers.get("packets", ""))
            self._connect()

    @property
    def unacknowledged(self) -> float:
        """See `Acknowledging`."""
        return len(self._unstored) / WINDOW

    def acknowledge(self) -> None:
        """See `Acknowledging`."""
        for mid in self._unstored:
            self._client.ack(mid, 1)
        self._unstored.clear()

    def close(self) -> None:
        """Disconnect."""
        self._client.on_disconnect = None
        self._client.disconnect()
        self._client.loop_stop()


def open_mqtt(opening: Opening) -> Source:
    """Open the source of a section.

    Raises:
        SourceError: If a topic breaks a rule, or names what feeds nothing.
        ConfigError: If the password is not set, or paho-mqtt is not installed.
    """
    section: MqttSourceSection = opening.section
    messages = messages_of(opening, "topics", (name for topic in section.topics.values() for name in topic.values))
    topics: dict[str, TopicMap] = {}
    subscribed: list[str] = []
    by_hand = opening.stored and section.client_id is not None and section.qos > 0
    if by_hand and section.qos == 2:
        rule = "is 2; set it to 1: a fleet with --store takes each of its messages once"
        raise failure(opening.loaded, (*opening.key, "qos"), rule)
    variable = section.password_env
    password = None if variable is None else secret(variable, (*opening.key, "password_env"), opening.loaded.places)
    for name, topic in section.topics.items():
        levels = name.split("/")
        asset = levels.index(ASSET_LEVEL) if opening.of_assets else None
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
        password=password,
        report=opening.report,
        subscribed=subscribed,
        by_hand=by_hand,
    )
