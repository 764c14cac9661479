"""Source of the nodes of an OPC UA server, which may go and come back."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Any

from app.twin.sources.kind import Opening
from app.twin.sources.push import messages_of
from estimators.errors import ConfigError, printable, quoted
from sources.messages import NO_BROKER, REFUSED, REFUSED_MESSAGE, RETRY_S, Messages
from sources.source import Report, Source

from .schema import OpcUaSourceSection

CHECK_S, STOP_TIMEOUT_S = 1.0, 2.0


class OpcUaSource:
    """Live source of the nodes of an OPC UA server, by subscription. A value of bad status is missing."""

    live = utc = True

    def __init__(self, messages: Messages, section: OpcUaSourceSection, report: Report) -> None:
        """Connect in a thread of its own; a server that is not there is waited for.

        Args:
            messages: Takes the messages.
            section: The server and its nodes.
            report: Receives lost connections.

        Raises:
            ConfigError: If asyncua is not installed, or a node id is none.
        """
        try:
            from asyncua import ua
        except ModuleNotFoundError:
            raise ConfigError("OPC UA needs asyncua: pip install 'nisus[opcua]'") from None
        self._messages, self._url, self._period = messages, section.url, section.every
        self.read, self.now = messages.read, messages.now
        self._names: dict[str, str] = {}
        for name, node in section.nodes.items():
            try:
                # As notifications spell it: i=85, not ns=0;i=85.
                self._names[ua.NodeId.from_string(node).to_string()] = name
            except Exception:  # noqa: BLE001  asyncua raises many kinds
                text = f"source: node {quoted(node)} of {name} is no node id; it must be like ns=2;s=Tank.Level"
                raise ConfigError(text) from None
        self._report = report
        self._last: dict[str, object] = {}
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
        message: dict[str, object] = {"source": self._url, "values": {name: number}}
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

    def datachange_notification(self, node: Any, _value: object, data: Any) -> None:
        """Take a changed value."""
        self._source.changed(self._names[node.nodeid.to_string()], data.monitored_item.Value)


def open_opcua(opening: Opening) -> Source:
    """Open the source of a section.

    Raises:
        SourceError: If a node feeds nothing.
        ConfigError: If a node id is none, or asyncua is not installed.
    """
    section: OpcUaSourceSection = opening.section
    messages = messages_of(opening, "nodes", section.nodes)
    return OpcUaSource(messages, section, opening.report)
