"""Fixtures of `app` that the tests of extensions use, and a broker."""

import pytest

from tests.app.conftest import browser, interruptible, nisus, shared_chromium, winding
from tests.app.web.conftest import serve
from tests.extensions.mqtt.broker import Broker

__all__ = ["browser", "interruptible", "nisus", "serve", "shared_chromium", "winding"]


@pytest.fixture
def broker(tmp_path):
    made = Broker(tmp_path)
    yield made
    if made.process.poll() is None:
        made.stop()
