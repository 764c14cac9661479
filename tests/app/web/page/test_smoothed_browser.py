"""Smoothed, on the page: drawn in its colour on the charts of states while it is on, and gone when it is off."""

import pytest

from tests.app.scripted import wait_for
from tests.app.web.page import test_runs_browser as runs
from tests.app.web.page.browsed import PATIENCE
from tests.app.web.page.test_runs_browser import page, session  # noqa: F401  fixtures

pytestmark = pytest.mark.browser

SMOOTHED = (38, 76, 70)
"""app/web/page/chart.css, --smoothed, in the light theme."""


def test_it_is_drawn_while_it_is_on(page, monkeypatch):  # noqa: F811
    monkeypatch.setattr(runs, "PINNED", SMOOTHED)
    chart = "#charts .chart canvas"
    before = runs.coloured(page, chart)
    button = page.locator("#smoothed")
    button.click()
    assert button.get_attribute("aria-pressed") == "true"
    wait_for(lambda: runs.coloured(page, chart) > before + 100, PATIENCE)
    button.click()
    wait_for(lambda: runs.coloured(page, chart) <= before + 20, PATIENCE)
