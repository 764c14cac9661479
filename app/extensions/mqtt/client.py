"""The connection to an MQTT broker."""

from __future__ import annotations

import socket
from typing import Any

from estimators.errors import ConfigError
from sources.messages import RETRY_S

from .schema import BrokerSection


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
        raise ConfigError("MQTT needs paho-mqtt: pip install 'nisus[mqtt]'") from None
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
