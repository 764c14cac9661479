"""OPC UA: a server with the states as variables, whose status code says whether they may be used."""

from __future__ import annotations

import asyncio
import hmac
import logging
import threading
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from app.engine.copies import OutputLink
from app.engine.outputs.state_message import StateMessage
from app.engine.running_fold import Running
from app.twin.secrets import Secrets
from estimators.errors import ConfigError

from .schema import OpcUaSection
from .source import run_again

if TYPE_CHECKING:
    from asyncua import Node, Server

NAMESPACE = "urn:nisus"

STATUS_CODES = {
    "waiting": "BadWaitingForInitialData",
    "tracking": "Good",
    "advisory": "Good",
    "suspect": "UncertainSubNormal",
    "degraded": "UncertainLastUsableValue",
    "diverged": "Bad",
    "withheld": "Bad",
    "stale": "BadNoCommunication",
}
"""Status code of a state by its grade."""

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
RETRY_S, STOP_TIMEOUT_S = 5.0, 2.0


class OpcUaOutput:
    """Serves the newest state from a thread of its own; clients read and subscribe, and cannot write."""

    name = "opcua"

    def __init__(self, section: OpcUaSection, engine: Running, secrets: Secrets) -> None:
        """Prepare; the port is not open yet.

        Raises:
            ConfigError: If asyncua is missing.
        """
        try:
            import asyncua  # noqa: F401
        except ModuleNotFoundError:
            raise ConfigError("OPC UA needs asyncua: pip install 'nisus[opcua]'") from None
        logging.getLogger("asyncua").setLevel(logging.CRITICAL)
        self._section, self._engine = section, engine
        self._password = None if section.password_env is None else secrets[section.password_env]
        self._loop = asyncio.new_event_loop()
        self._stopping, self._fresh = asyncio.Event(), asyncio.Event()
        self._message: StateMessage | None = None
        self._serving, self._problem = False, "not served yet"
        self._thread = threading.Thread(target=self._run, name="OPC UA server", daemon=True)

    @property
    def url(self) -> str:
        """Address of the server."""
        return f"opc.tcp://{self._section.host}:{self._section.port}/nisus"

    def start(self) -> None:
        """See `Output`."""
        self._thread.start()

    def publish(self, message: StateMessage) -> None:
        """See `Output`; of several states before the server takes one, the newest counts."""
        self._message = message
        self._tell(self._fresh)

    def stop(self) -> None:
        """See `Output`."""
        if self._thread.is_alive():
            self._tell(self._stopping)
            self._tell(self._fresh)
            self._thread.join(STOP_TIMEOUT_S)

    def _tell(self, event: asyncio.Event) -> None:
        """Set an event of the server's loop, unless that has ended."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(event.set)

    def link(self) -> OutputLink:
        """See `Output`."""
        return OutputLink(self._serving, self.url if self._serving else self._problem)

    # On the thread of the server

    def _run(self) -> None:
        """Serve until the twin stops; if the port is in use, try again."""
        run_again(self._loop, self._serve, self._stopping, RETRY_S, self._failed)
        self._serving = False

    def _failed(self, problem: str) -> None:
        self._serving = False
        if problem != self._problem:
            text = f"output opcua: {self.url} is not served ({problem}); it is tried again"
            self._engine.notices.say(text, level="warn")
            self._engine.notices.count("output opcua")
        self._problem = problem

    async def _serve(self) -> None:
        from asyncua import Server, ua

        server = Server(user_manager=self._users())
        await server.init()
        server.set_endpoint(self.url)
        server.set_server_name(f"Nisus {self._engine.twin.name}")
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        index = await server.register_namespace(NAMESPACE)
        nodes = await self._nodes(server, index)
        async with server:
            self._serving = True
            while not self._stopping.is_set():
                await self._fresh.wait()
                self._fresh.clear()
                if self._message is not None and not self._stopping.is_set():
                    for name, value in values_of(self._message).items():
                        await server.write_attribute_value(nodes[name].nodeid, value)

    def _users(self) -> object:
        """Return the manager of users: none may write, and with a password only its user may read."""
        from asyncua.crypto.permission_rules import User, UserRole
        from asyncua.server.user_managers import UserManager

        user, wanted = self._section.user, self._password

        class Readers(UserManager):
            def get_user(
                self, iserver: Any, username: str | None = None, password: str | None = None, certificate: Any = None
            ) -> User | None:
                if wanted is not None:
                    right = hmac.compare_digest((password or "").encode(), wanted.encode())
                    if username != user or not right:
                        return None
                return User(role=UserRole.User)

        return Readers()

    async def _nodes(self, server: Server, index: int) -> dict[str, Node]:
        """Add the variables of the twin; return them by name."""
        from asyncua import ua

        name, model = self._engine.twin.name, self._engine.model
        folder = await server.nodes.objects.add_folder(ua.NodeId(name, index), ua.QualifiedName(name, index))
        found: dict[str, Node] = {}

        async def add(parent: Node, path: str, label: str, kind: ua.VariantType, start: object) -> Node:
            node_id, text = ua.NodeId(f"{name}.{path}", index), ua.QualifiedName(label, index)
            value = ua.DataValue(ua.Variant(start, kind), ua.StatusCode(ua.StatusCodes.BadWaitingForInitialData))
            found[path] = await parent.add_variable(node_id, text, ua.Variant(start, kind))
            await server.write_attribute_value(found[path].nodeid, value)
            return found[path]

        for state in model.shown_states:
            node = await add(folder, state.name, state.name, ua.VariantType.Double, 0.0)
            unit = ua.NodeId(f"{name}.{state.name}.unit", index)
            await node.add_property(unit, ua.QualifiedName("unit", index), state.unit)
            for part in ("std", "protection_level"):
                await add(node, f"{state.name}.{part}", part, ua.VariantType.Double, 0.0)
        for part in ("health", "cause", "message"):
            await add(folder, part, part, ua.VariantType.String, "")
        return found


def values_of(message: StateMessage) -> dict[str, object]:
    """Return a value (asyncua's DataValue) for each variable."""
    from asyncua import ua

    ns = message.time_ns if message.time is not None else None
    stamp = None if ns is None else EPOCH + timedelta(microseconds=ns // 1000)

    def data(value: object, kind: ua.VariantType, code: str) -> ua.DataValue:
        # A value of bad status is to be ignored: there is none.
        variant = ua.Variant(value, kind) if value is not None else ua.Variant(None, ua.VariantType.Null)
        return ua.DataValue(variant, ua.StatusCode(getattr(ua.StatusCodes, code)), SourceTimestamp=stamp)

    found: dict[str, object] = {}
    for state in message.states:
        code = STATUS_CODES[state.grade]
        for path, value in (
            (state.name, state.value),
            (f"{state.name}.std", state.std),
            (f"{state.name}.protection_level", state.protection_level),
        ):
            absent = "BadWaitingForInitialData" if state.valid else code
            found[path] = data(value, ua.VariantType.Double, code if value is not None else absent)
    for path, text in (
        ("health", message.health),
        ("cause", message.cause),
        ("message", message.model_dump_json()),
    ):
        found[path] = data(text, ua.VariantType.String, "Good")
    return found
