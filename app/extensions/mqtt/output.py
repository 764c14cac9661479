"""MQTT: states, birth, last will and alerts at a broker, as JSON under PREFIX/TWIN."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from app.engine.copies import OutputLink
from app.engine.notices import Notices
from app.engine.outputs.alerts import AlertMessage
from app.engine.outputs.receivers import TIMEOUT_S
from app.engine.outputs.state_message import StateMessage, iso_now, state_schema
from app.engine.running_fold import Running
from app.twin.secrets import Secrets
from estimators.errors import printable
from estimators.model.state_space import Input, State, StateSpaceModel

from .client import mqtt_client
from .schema import MqttSection

if TYPE_CHECKING:
    from paho.mqtt.client import Client
    from paho.mqtt.reasoncodes import ReasonCode

MAX_UNSENT = 100
"""States that the connection has not taken; with more, a broker that reads too slowly loses some."""

ESCAPES = {ord(mark): f"%{ord(mark):02X}" for mark in "%+#/\0"}
"""Characters of the name of an asset that cannot be in a level of a topic, and the escape."""

STATUS, BIRTH, STATE, ALERT = "status", "birth", "state", "alert"
"""Last parts of the topics."""


class Packet(NamedTuple):
    """A message to the broker."""

    topic: str
    payload: str
    qos: int = 0
    retain: bool = False


class MqttOutput:
    """Publishes JSON through a thread of paho-mqtt, which connects again for as long as the twin runs.

    The topics are under PREFIX/TWIN; those of the assets of a fleet under PREFIX/FLEET/ASSET.
    """

    name = "mqtt"

    def __init__(
        self,
        section: MqttSection,
        name: str,
        model: Callable[[], StateSpaceModel],
        notices: Notices,
        secrets: Secrets,
        *,
        of_assets: bool = False,
    ) -> None:
        """Prepare; nothing is connected yet.

        Args:
            section: The broker.
            name: Name of the twin or fleet.
            model: Returns its present model.
            notices: Where problems are reported.
            secrets: See `secrets_of`.
            of_assets: Whether states are those of assets. They are retained, as one is published when it changes.

        Raises:
            ConfigError: If paho-mqtt is missing.
        """
        self._section, self._notices = section, notices
        self._name, self._model, self._of_assets = name, model, of_assets
        self._root = f"{section.prefix}/{name}"
        password = None if section.password_env is None else secrets[section.password_env]
        self.client = mqtt_client(section, password, client_id=f"nisus-{name}")
        self.client.on_pre_connect = self._connecting
        self.client.on_connect, self.client.on_disconnect = self._connected, self._disconnected
        self.client.on_connect_fail = lambda *_: self._lost("the broker does not answer")
        self.client.on_publish = self._taken
        self._unsent, self._dropped, self._counting = 0, 0, threading.Lock()
        self._problem = "not connected yet"
        self.connections = 0
        """How often it was connected."""
        self._reported = False

    def start(self) -> None:
        """See `Output`."""
        self.client.connect_async(self._section.host, self._section.port, keepalive=15)
        self.client.loop_start()

    @property
    def room(self) -> int:
        """Number of states that the connection takes now."""
        with self._counting:
            return max(0, MAX_UNSENT - self._unsent) if self.client.is_connected() else 0

    def publish(self, message: StateMessage) -> None:
        """See `Output`."""
        if not self.client.is_connected():
            return
        with self._counting:
            full = self._unsent >= MAX_UNSENT
            self._dropped += full
            first = full and self._dropped == 1
        if not full:
            self._hand_over([self._state(message)])
        elif first:
            text = f"output mqtt: the broker at {self._place} takes states too slowly; some are dropped"
            self._notices.count("output mqtt")
            self._notices.say(text, level="warn")

    def send(self, alert: AlertMessage) -> None:
        """Publish an alert (see `alerts.Receiver`); it waits while there is no broker.

        Raises:
            OSError: If the broker does not confirm it.
        """
        if not self.client.is_connected():
            raise OSError(self._problem)
        with self._counting:
            self._unsent += 1
        sent = self.client.publish(f"{self._root}/{ALERT}", alert.model_dump_json(), qos=1)
        try:
            sent.wait_for_publish(TIMEOUT_S)
        except RuntimeError as error:
            raise OSError(str(error)) from None
        if not sent.is_published():
            raise OSError(f"the broker did not confirm it within {TIMEOUT_S:g} s")

    def stop(self) -> None:
        """Publish the death, and disconnect."""
        if self.client.is_connected():
            sent = self.client.publish(*self._status(online=False))
            try:
                sent.wait_for_publish(1.0)
            except (RuntimeError, ValueError):
                pass  # the last will says the same
        self.client.on_disconnect = None
        self.client.disconnect()
        self.client.loop_stop()

    def link(self) -> OutputLink:
        """See `Output`."""
        connected = bool(self.client.is_connected())
        return OutputLink(connected, self._place if connected else self._problem)

    @property
    def _place(self) -> str:
        return f"{self._section.host}:{self._section.port}, {self._root}"

    def _hand_over(self, packets: list[Packet]) -> None:
        with self._counting:
            self._unsent += len(packets)
        for packet in packets:
            self.client.publish(*packet)

    # Messages

    def _state(self, message: StateMessage) -> Packet:
        """Return the message of a state."""
        place = f"{self._root}/{message.twin.translate(ESCAPES)}" if self._of_assets else self._root
        return Packet(f"{place}/{STATE}", message.model_dump_json(), retain=self._of_assets)

    def _status(self, *, online: bool) -> Packet:
        """Return whether the twin is online; as last will, the broker publishes the end when it loses a connection."""
        body = json.dumps({"online": online, "since": iso_now()})
        return Packet(f"{self._root}/{STATUS}", body, qos=1, retain=True)

    def _birth(self) -> Packet:
        """Return the first message of a connection: names and units of all values, and the schema of the messages."""
        model = self._model()
        parts: dict[str, tuple[State | Input, ...]] = {"states": model.shown_states, "inputs": model.inputs}
        names = {key: [{"name": item.name, "unit": item.unit} for item in items] for key, items in parts.items()}
        told = {"twin": self._name, "since": iso_now(), **names, "sensors": list(model.sensor_names)}
        body = json.dumps(told | {"schema": state_schema()})
        return Packet(f"{self._root}/{BIRTH}", body, qos=1, retain=True)

    # On the thread of the client

    def _connecting(self, client: Client, _data: object) -> None:
        client.will_set(*self._status(online=False))

    def _connected(self, _client: object, _data: object, _flags: object, reason: ReasonCode, *_: object) -> None:
        if reason.is_failure:
            self._lost(f"the broker refuses: {reason}")
            return
        with self._counting:
            self._unsent, self._dropped = 0, 0
        self.connections += 1
        self._hand_over([self._birth(), self._status(online=True)])
        if self._reported:
            self._reported = False
            self._notices.say(f"output mqtt: connected again to {self._place}")

    def _disconnected(self, _client: object, _data: object, _flags: object, reason: object, *_: object) -> None:
        self._lost(f"the connection ended: {reason}")

    def _lost(self, text: str) -> None:
        self._problem = printable(text)
        if not self._reported:
            self._reported = True
            place = f"{self._section.host}:{self._section.port}"
            self._notices.say(f"output mqtt: no broker at {place} ({self._problem}); it is tried again", level="warn")
            self._notices.count("output mqtt")

    def _taken(self, *_: object) -> None:
        with self._counting:
            self._unsent = max(0, self._unsent - 1)


def mqtt_output(section: MqttSection, engine: Running, secrets: Secrets) -> MqttOutput:
    """Return the output of a running twin, which is a receiver of its alerts too."""
    return MqttOutput(section, engine.twin.name, lambda: engine.model, engine.notices, secrets)
