"""A Mosquitto of a test's own on loopback, and a client that keeps what it hears."""

import json
import socket
import subprocess
import threading
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho

from tests.skips import program
from tests.support import free_port
from tests.waiting import LIMIT_S, wait_for


class Broker:
    """A Mosquitto that may be stopped and started again at its port; the test skips where it is not installed."""

    def __init__(self, folder: Path, more: str = "") -> None:
        self.program, self.port = program("mosquitto"), free_port()
        self.settings = folder / "mosquitto.conf"
        self.settings.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence false\nset_tcp_nodelay true\n{more}"
        )
        self.start()

    def start(self) -> None:
        command = [self.program, "-c", str(self.settings)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_for(lambda: self.answers() or self.process.poll() is not None)
        assert self.process.poll() is None, "mosquitto does not start"

    def answers(self) -> bool:
        try:
            socket.create_connection(("127.0.0.1", self.port), 1.0).close()
        except OSError:
            return False
        return True

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(LIMIT_S)


class Listener:
    """Subscribes to everything, and keeps topic, payload and retain flag of each message."""

    def __init__(self, broker: Broker) -> None:
        self.heard: list[tuple[str, Any, bool]] = []
        self.ready = threading.Event()
        self.client = paho.Client(paho.CallbackAPIVersion.VERSION2)  # type: ignore[attr-defined]
        self.client.on_connect = lambda client, *_: client.subscribe("#", qos=1)
        self.client.on_subscribe = lambda *_: self.ready.set()
        self.client.message_callback_add("nisus/#", lambda _client, _data, item: self.heard.append(
            (item.topic, json.loads(item.payload), item.retain)
        ))  # fmt: skip
        self.client.connect("127.0.0.1", broker.port)
        self.client.loop_start()
        assert self.ready.wait(LIMIT_S)

    def of(self, topic: str) -> list[Any]:
        return [body for name, body, _ in self.heard.copy() if name == topic]

    def publish(self, topic: str, body: Any, **options: Any) -> None:
        text = body if isinstance(body, str | bytes) else json.dumps(body)
        self.client.publish(topic, text, qos=1, **options).wait_for_publish(LIMIT_S)

    def stop(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()
