"""A Viser server for scenes that no browser shows."""

import pytest
import viser


@pytest.fixture(scope="session")
def server():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()
