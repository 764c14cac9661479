"""Sources of messages from an MQTT broker or an OPC UA server, which may go and come back."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from typing import Any, Protocol

from estimators.errors import ConfigError, printable, quoted
from estimators.log import Events

from .messages import LATEST, REFUSED, Messages
from .source import Report

NO_BROKER = "no broker"  # Key of the times at which the connection was lost
REFUSED_MESSAGE = "message refused"  # Key of messages that cannot be read
REFUSED_TOPIC = "topic refused"  # Key of topics that the broker does not deliver

UNITS = {"s": 10**9, "ms": 10**6, "us": 1000, "ns": 1}
"""Nanoseconds of the units of a time."""

MAX_PAYLOAD_BYTES = 64 * 1024
"""Largest payload of a topic; a message takes a hundred bytes."""

RETRY_S, CHECK_S, STOP_TIMEOUT_S = 1.0, 1.0, 2.0


class BrokerSection(Protocol):
    """Address and login of a broker."""

    host: str
    port: int
    user: str | None
    ca_file: str | None


def mqtt_client(section: BrokerSection, password: str | None, *, client_id: str, persistent: bool = False) -> Any:
    """Return a client of paho-mqtt that connects again by itself; `persistent` keeps its session at the broker.

    Raises:
        ConfigError: If paho-mqtt is not installed.
    """
    try:
        import paho.mqtt.client as paho
    except ModuleNotFoundError:
        raise ConfigError("MQTT needs paho-mqtt: pip install 'nisus[service]'") from None
    api = paho.CallbackAPIVersion.VERSION2  # type: ignore[attr-defined]
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


class MqttSource:
    """Live source of the topics of an MQTT broker."""

    live = True

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
        """
        self._messages, self._topics, self._qos, self._report = messages, topics, qos, report
        self._place = f"{section.host}:{section.port}"
        self._client = mqtt_client(section, password, client_id=client_id or "", persistent=client_id is not None)
        self._client.on_connect, self._client.on_disconnect = self._connected, self._disconnected
        self._client.on_connect_fail = lambda *_: self._lost("it does not answer")
        for name in topics:
            self._client.message_callback_add(name, self._callback(topics[name]))
        self.connected = threading.Event()
        """Set while the topics are subscribed to."""
        self._client.on_subscribe = self._subscribed
        self._client.connect_async(section.host, section.port, keepalive=15)
        self._client.loop_start()

    def _connected(self, client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._lost(f"it refuses: {reason}")
        else:
            client.subscribe([(name, self._qos) for name in self._topics])

    def _subscribed(self, _client: Any, _data: Any, _number: Any, reasons: Any, _properties: Any) -> None:
        for name, reason in zip(self._topics, reasons, strict=False):
            if reason.is_failure:
                text = f"the broker at {self._place} refuses the topic {name} ({reason}); check the rights of the user"
                self._report(REFUSED_TOPIC, text)
        self.connected.set()

    def _disconnected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self._lost(f"the connection ended: {reason}")

    def _lost(self, why: str) -> None:
        self.connected.clear()
        self._report(
            NO_BROKER, f"no measurements from the broker at {self._place}: {printable(why)}; it is tried again"
        )

    def _callback(self, topic: TopicMap) -> Any:
        def arrived(_client: Any, _data: Any, message: Any) -> None:
            try:
                found = topic.message(message.topic, message.payload)
                # The broker sends the last retained message to each new subscriber: without a time it is of no moment.
                if message.retain and found.get("time") is None:
                    return
                answer = self._messages.send([found])[0]
                reason = answer.reason if answer.status == REFUSED else ""
            except Exception as error:  # noqa: BLE001  no payload may end the source
                reason = str(error)
            if reason:
                self._report(REFUSED_MESSAGE, f"{printable(message.topic)[:100]}: {printable(reason)}; it is not used")

        return arrived

    def read(self, timeout: float) -> Any:
        """Return the events of the next messages."""
        return self._messages.read(timeout)

    def now(self) -> int | None:
        """Return the present time by the clock of the senders, ns."""
        return self._messages.now()

    def close(self) -> None:
        """Disconnect."""
        self._client.on_disconnect = None
        self._client.disconnect()
        self._client.loop_stop()


class OpcUaSource:
    """Live source of the nodes of an OPC UA server, by subscription. A value of bad status is missing."""

    live = True

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
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._stay())
        self._loop.close()

    async def _stay(self) -> None:
        """Subscribe, again and again, until the source is closed."""
        while not self._stopping.is_set():
            try:
                await self._subscribed()
            except Exception as error:  # noqa: BLE001  asyncua raises many kinds; the server is tried again
                why = printable(str(error) or type(error).__name__)
                text = f"no measurements from the server at {self._url}: {why}; it is tried again"
                self._report(NO_BROKER, text)
            self.connected.clear()
            await self._pause(RETRY_S)

    async def _pause(self, seconds: float) -> None:
        try:
            await asyncio.wait_for(self._stopping.wait(), seconds)
        except TimeoutError:
            pass

    async def _subscribed(self) -> None:
        from asyncua import Client

        async with Client(self._url) as client:
            subscription = await client.create_subscription(self._period * 1e3, NodeHandler(self, self._names))
            await subscription.subscribe_data_change([client.get_node(node) for node in self._names])
            self.connected.set()
            while not self._stopping.is_set():
                await self._pause(CHECK_S)
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

    def read(self, timeout: float) -> Events | None:
        """Return the events of the next values."""
        return self._messages.read(timeout)

    def now(self) -> int | None:
        """Return the present time by the clock of the server, ns."""
        return self._messages.now()

    def close(self) -> None:
        """Disconnect."""
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._stopping.set)
        self._thread.join(STOP_TIMEOUT_S)


class NodeHandler:
    """Hands changed values of a subscription to the source (asyncua's protocol)."""

    def __init__(self, source: OpcUaSource, names: Mapping[str, str]) -> None:
        self._source = source
        self._names = dict(names)

    def datachange_notification(self, node: Any, _value: Any, data: Any) -> None:
        """Take a changed value."""
        self._source.changed(self._names[node.nodeid.to_string()], data.monitored_item.Value)
