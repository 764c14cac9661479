"""A local source of recordings."""

import pytest

from app.extensions.data.gallery import jobs
from tests.extensions.data.origin import serving


@pytest.fixture
def origin(monkeypatch):
    """The server, with its `address`; pooch does not rest between attempts."""
    monkeypatch.setattr("pooch.core.time.sleep", lambda _: None)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    jobs.clear()
    with serving() as (origin, address):
        origin.address = address
        yield origin
    jobs.clear()
