"""The broker and the client of MQTT's tests."""

from tests.extensions.mqtt.conftest import broker, listener

__all__ = ["broker", "listener"]
