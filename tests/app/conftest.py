"""A browser for the tests of a file."""

from collections.abc import Iterator
from typing import Any

import pytest

from tests.chromium import launched


@pytest.fixture(scope="module")
def browser(chromium: str) -> Iterator[Any]:
    """Chromium, as Playwright drives it; each test opens a page of its own in it."""
    with launched(chromium) as started:
        yield started
