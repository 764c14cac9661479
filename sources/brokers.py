"""Sources of messages from an MQTT broker or an OPC UA server, which may go and come back."""

from __future__ import annotations

import asyncio
import base64
import json
import queue
import re
import socket
import threading
import zlib
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from typing import Any, Protocol

import numpy as np

from estimators.errors import ConfigError, printable, quoted

from .messages import LATEST, MAX_WAITING, NO_BROKER, REFUSED, REFUSED_MESSAGE, REFUSED_TOPIC, RETRY_S, Messages
from .source import Report
from .tables.text import no_value

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

CHECK_S, STOP_TIMEOUT_S = 1.0, 2.0


class BrokerSection(Protocol):
    """Address and login of a broker."""

    host: str
    port: int
    user: str | None
    ca_file: str | None


def mqtt_client(
    section: BrokerSection, password: str | None, *, client_id: str, persistent: bool = False, by_hand: bool = False
) -> Any:
    """Return a client of paho-mqtt that connects again by itself; `persistent` keeps its session at the broker.

    With `by_hand` it is one of MQTT 5, whose messages are acknowledged with its `ack`.

    Raises:
        ConfigError: If paho-mqtt is not installed.
    """
    try:
        import paho.mqtt.client as paho
    except ModuleNotFoundError:
        raise ConfigError("MQTT needs paho-mqtt: pip install 'nisus[service]'") from None
    api = paho.CallbackAPIVersion.VERSION2  # type: ignore[attr-defined]
    if by_hand:
        client = paho.Client(api, client_id=client_id, protocol=paho.MQTTv5, manual_ack=True)
    else:
        client = paho.Client(api, client_id=client_id, clean_session=not persistent)
    client.reconnect_delay_set(RETRY_S, 30.0)
    # An error of a callback would end the thread of the client, and with it all messages.
    client.suppress_exceptions = True
    # Otherwise a small message waits for the acknowledgement of the one before, up to 40 ms.
    client.on_socket_open = lambda _client, _data, opened: opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    client.max_queued_messages_set(1000)
    if section.user is not None:
        client.username_pw_set(section.user, password)
    if section.ca_file is not None:
        client.tls_set(section.ca_file)
    return client


@dataclass(frozen=True)
class TopicMap:
    """Where the payloads of a topic have their values; paths are dotted, "" is the whole payload.

    `values` has the path by name; without any the payload is a message itself (see `Messages`). `unit` is that of a
    time in numbers. Where the value at `quality` is not one of `good`, all values are missing. `asset` is the level of
    the topic with the name of the asset, counted from 0; None if there is none.
    """

    values: Mapping[str, str] = field(default_factory=dict)
    time: str | None = None
    unit: str = "ns"
    quality: str | None = None
    good: Sequence[str] = ()
    sequence: str | None = None
    asset: int | None = None

    def message(self, topic: str, payload: bytes) -> dict[str, Any]:
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
        found: dict[str, Any] = {
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


def as_time(value: Any, unit: str) -> Any:
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

    def add(self, packet: Any) -> bool:
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
        section: BrokerSection,
        topics: Mapping[str, TopicMap],
        *,
        qos: int,
        password: str | None,
        client_id: str | None,
        report: Report,
        subscribed: Sequence[str] | None = None,
        by_hand: bool = False,
    ) -> None:
        """Connect in a thread of its own; a broker that is not there is waited for.

        Args:
            messages: Takes the messages.
            section: Address of the broker.
            topics: By filter, which may have the wildcards + and #.
            qos: Quality of service.
            password: Of the user.
            client_id: With one, the broker keeps messages of QoS 1 while the twin is away.
            report: Receives lost connections and payloads that cannot be read.
            subscribed: Filters to subscribe to in place of those of `topics`, of which each is a part.
            by_hand: Acknowledge messages once they have been stored, see `Acknowledging`; connect after `restore`.
        """
        self.messages, self._qos, self._report = messages, qos, report
        self.now = messages.now
        self._subscribed_to = [*topics] if subscribed is None else [*subscribed]
        self._place, self._section = f"{section.host}:{section.port}", section
        self._client = mqtt_client(
            section, password, client_id=client_id or "", persistent=client_id is not None, by_hand=by_hand
        )
        self._client.on_connect, self._client.on_disconnect = self._connected, self._disconnected
        self._client.on_connect_fail = lambda *_: self._lost("it does not answer")
        for name, topic in topics.items():
            self._client.message_callback_add(SHARED.sub("", name), self._callback(topic))
        self.connected = threading.Event()
        """Set while the topics are subscribed to."""
        self._client.on_subscribe = self._subscribed
        self._requests: dict[int | None, list[str]] = {}
        self._waiting: queue.SimpleQueue[tuple[TopicMap, Any]] = queue.SimpleQueue()
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

    def _connected(self, client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._lost(f"it refuses: {reason}")
            return
        self._requests.clear()
        for at in range(0, len(self._subscribed_to), MAX_TOPICS):
            names = self._subscribed_to[at : at + MAX_TOPICS]
            self._requests[client.subscribe([(name, self._qos) for name in names])[1]] = names

    def _subscribed(self, _client: Any, _data: Any, number: Any, reasons: Any, _properties: Any) -> None:
        for name, reason in zip(self._requests.pop(number, self._subscribed_to), reasons, strict=False):
            if reason.is_failure:
                text = f"the broker at {self._place} refuses the topic {name} ({reason}); check the rights of the user"
                self._report(REFUSED_TOPIC, text)
        if not self._requests:
            self.connected.set()

    def _disconnected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self._lost(f"the connection ended: {reason}")

    def _lost(self, why: str) -> None:
        self.connected.clear()
        self._report(
            NO_BROKER, f"no measurements from the broker at {self._place}: {printable(why)}; it is tried again"
        )

    def _callback(self, topic: TopicMap) -> Any:
        def arrived(client: Any, _data: Any, packet: Any) -> None:
            if self._waiting.qsize() < MAX_WAITING:
                self._waiting.put((topic, packet))
                return
            if self._by_hand and packet.qos:
                client.ack(packet.mid, packet.qos)
            self._refuse(packet, "too many messages wait")

        return arrived

    def read(self, timeout: float) -> Any:
        """Return the events of the next messages."""
        found: list[tuple[TopicMap, Any]] = []
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

    def _is_new(self, packet: Any) -> bool:
        """Return whether a packet is used; one that was stored before is acknowledged again."""
        if not self._by_hand or not packet.qos:
            return True
        if self._packets.add(packet):
            self._unstored[packet.mid] = None
            return True
        if packet.mid not in self._unstored:
            self._client.ack(packet.mid, packet.qos)
        return False

    def _decoded(self, topic: TopicMap, packet: Any) -> dict[str, Any] | None:
        """Return the message of a packet; None if it has none."""
        try:
            found = topic.message(packet.topic, packet.payload)
        except Exception as error:  # noqa: BLE001  no payload may end the source
            self._refuse(packet, str(error))
            return None
        # The broker sends the last retained message to each new subscriber: without a time it is of no moment.
        return None if packet.retain and found.get("time") is None else found

    def _refuse(self, packet: Any, reason: str) -> None:
        self._report(REFUSED_MESSAGE, f"{printable(packet.topic)[:100]}: {printable(reason)}; it is not used")

    @property
    def mark(self) -> int:
        """Messages that were accepted and read."""
        return self.messages.mark

    def numbers(self, mark: int) -> dict[str, Any]:
        """See `Marked`."""
        numbers = self.messages.numbers(mark)
        return {"senders": numbers, "packets": self._packets.state()} if self._by_hand else numbers

    def restore(self, numbers: Mapping[str, Any]) -> None:
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


class OpcUaSource:
    """Live source of the nodes of an OPC UA server, by subscription. A value of bad status is missing."""

    live = utc = True

    def __init__(
        self, messages: Messages, url: str, nodes: Mapping[str, str], *, period: float, report: Report
    ) -> None:
        """Connect in a thread of its own; a server that is not there is waited for.

        Args:
            messages: Takes the messages.
            url: Address of the server, opc.tcp://...
            nodes: Node id by the name of its value.
            period: Publishing interval, s.
            report: Receives lost connections.

        Raises:
            ConfigError: If asyncua is not installed, or a node id is none.
        """
        try:
            from asyncua import ua
        except ModuleNotFoundError:
            raise ConfigError("OPC UA needs asyncua: pip install 'nisus[service]'") from None
        self._messages, self._url, self._period = messages, url, period
        self.read, self.now = messages.read, messages.now
        self._names: dict[str, str] = {}
        for name, node in nodes.items():
            try:
                # As notifications spell it: i=85, not ns=0;i=85.
                self._names[ua.NodeId.from_string(node).to_string()] = name
            except Exception:  # noqa: BLE001  asyncua raises many kinds
                text = f"source: node {quoted(node)} of {name} is no node id; it must be like ns=2;s=Tank.Level"
                raise ConfigError(text) from None
        self._report = report
        self._last: dict[str, tuple[Any, Any]] = {}
        self.connected = threading.Event()
        """Set while the nodes are subscribed to."""
        self._loop = asyncio.new_event_loop()
        self._stopping = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="OPC UA source", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        """Subscribe, again and again, until the source is closed."""
        run_again(self._loop, self._subscribed, self._stopping, RETRY_S, self._failed)
        self.connected.clear()

    def _failed(self, why: str) -> None:
        self.connected.clear()
        self._report(NO_BROKER, f"no measurements from the server at {self._url}: {why}; it is tried again")

    async def _subscribed(self) -> None:
        from asyncua import Client

        async with Client(self._url) as client:
            subscription = await client.create_subscription(self._period * 1e3, NodeHandler(self, self._names))
            await subscription.subscribe_data_change([client.get_node(node) for node in self._names])
            self.connected.set()
            while not self._stopping.is_set():
                await _pause(self._stopping, CHECK_S)
                await client.check_connection()

    def changed(self, name: str, value: Any) -> None:
        """Take a changed value (asyncua's DataValue) of a node."""
        stamp = value.SourceTimestamp
        number = None if value.StatusCode.is_bad() or value.Value is None else value.Value.Value
        # A new subscription begins with the value that was known before.
        if stamp is not None and self._last.get(name) == (stamp, number):
            return
        self._last[name] = stamp, number
        message: dict[str, Any] = {"source": self._url, "values": {name: number}}
        if stamp is not None:
            message["time"] = f"{stamp.replace(tzinfo=None).isoformat()}Z"
        answer = self._messages.send([message])[0]
        if answer.status == REFUSED:
            self._report(REFUSED_MESSAGE, f"{name}: {answer.reason}; it is not used")

    def close(self) -> None:
        """Disconnect."""
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._stopping.set)
        self._thread.join(STOP_TIMEOUT_S)


def run_again(
    loop: asyncio.AbstractEventLoop,
    work: Callable[[], Awaitable[None]],
    stopping: asyncio.Event,
    retry: float,
    failed: Callable[[str], None],
) -> None:
    """Run work in a loop of this thread, again `retry` seconds after its end, until `stopping` is set.

    `failed` is called with the reason of each failure.
    """

    async def stay() -> None:
        while not stopping.is_set():
            try:
                await work()
            except Exception as error:  # noqa: BLE001  asyncua raises many kinds; no client may end the thread
                failed(printable(str(error) or type(error).__name__))
            await _pause(stopping, retry)

    asyncio.set_event_loop(loop)
    loop.run_until_complete(stay())
    loop.close()


async def _pause(stopping: asyncio.Event, seconds: float) -> None:
    with suppress(TimeoutError):
        await asyncio.wait_for(stopping.wait(), seconds)


class NodeHandler:
    """Hands changed values of a subscription to the source (asyncua's protocol)."""

    def __init__(self, source: OpcUaSource, names: Mapping[str, str]) -> None:
        self._source = source
        self._names = dict(names)

    def datachange_notification(self, node: Any, _value: Any, data: Any) -> None:
        """Take a changed value."""
        self._source.changed(self._names[node.nodeid.to_string()], data.monitored_item.Value)
