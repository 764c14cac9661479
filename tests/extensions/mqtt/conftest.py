"""A broker of a test's own, and a client of it."""

import pytest

from tests.extensions.mqtt.broker import Broker, Listener


@pytest.fixture
def broker(tmp_path):
    made = Broker(tmp_path)
    yield made
    if made.process.poll() is None:
        made.stop()


@pytest.fixture
def listener(broker):
    made = Listener(broker)
    yield made
    made.stop()
