import pytest

from tests.app.outputs.broker import Broker
from tests.app.web.conftest import serve

__all__ = ["serve"]


@pytest.fixture
def broker(tmp_path):
    made = Broker(tmp_path)
    yield made
    if made.process.poll() is None:
        made.stop()
