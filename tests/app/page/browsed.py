"""The page of a session in Chromium, as tests look at it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from app.session import Session
from tests.app.scripted import wait_for

FLAGS = "--headless=new --no-sandbox --disable-gpu --enable-unsafe-swiftshader --no-first-run".split()

PATIENCE = 120.0
"""Seconds for a step on a busy machine; a test that works takes a fraction."""


@contextmanager
def browsed(chromium: str, session: Session) -> Iterator[Any]:
    """A light page of 1440 × 900, once it has drawn; nothing in it may have raised when it is closed."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_context(viewport={"width": 1440, "height": 900}, color_scheme="light").new_page()
        page.set_default_timeout(PATIENCE * 1000)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(session.url)
        wait_for(lambda: page.evaluate("window.nisus?.drawn > 0"), PATIENCE)
        yield page
        assert errors == []
        browser.close()
