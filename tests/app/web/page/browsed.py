"""The page of a session in Chromium, as tests look at it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from app.web.session import Session
from tests.app.scripted import wait_for

PATIENCE = 120.0
"""Seconds for a step on a busy machine without a graphics card; a test that works takes a fraction."""


def until(page: Any, expression: str) -> None:
    """Ask from outside: the page's own policy forbids the evaluation that waiting inside it would need."""

    def holds() -> object:
        try:
            return page.evaluate(expression)
        except Exception:  # noqa: BLE001  a page that is being left: there is nobody to answer
            return False

    wait_for(holds, PATIENCE)


@contextmanager
def browsed(browser: Any, session: Session) -> Iterator[Any]:
    """A light page of 1440 × 900, once it has drawn; nothing in it may have raised when it is closed."""
    page = browser.new_context(viewport={"width": 1440, "height": 900}, color_scheme="light").new_page()
    page.set_default_timeout(PATIENCE * 1000)
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(session.url)
    until(page, "window.nisus?.drawn > 0")
    yield page
    page.context.close()
    assert errors == []
