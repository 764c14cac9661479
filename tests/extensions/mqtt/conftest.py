"""A broker of a test's own."""

import pytest

from tests.extensions.mqtt.broker import Broker


@pytest.fixture
def broker(tmp_path):
    made = Broker(tmp_path)
    yield made
    if made.process.poll() is None:
        made.stop()
