"""The broker of MQTT's tests."""

from tests.extensions.mqtt.conftest import broker

__all__ = ["broker"]
