"""The page that most browser tests open."""

import pytest

from tests.app.web.page.browsed import browsed


@pytest.fixture
def page(browser, session):
    """The page of the session of the test's module."""
    with browsed(browser, session) as page:
        yield page
