"""The page of a session in Chromium, as tests look at it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from app.cli.run import live_source
from app.twin.twin import load_twin
from app.web.session import Page, Session
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
def running(name: str, speed: float = float("inf"), **overrides: str) -> Iterator[Session]:
    """A session of a twin with its page; played as fast as possible, it has ended."""
    twin = load_twin(name, overrides=overrides)
    session = Session(twin, live_source(twin, speed), page=Page(0, open_browser=False))
    session.start()
    try:
        if speed == float("inf"):
            wait_for(lambda: session.engine.status().finished, PATIENCE)
        yield session
    finally:
        session.stop()


@contextmanager
def browsed(browser: Any, session: Session, width: int = 1440, scheme: str = "light") -> Iterator[Any]:
    """A page of a height of 900 px, once it has drawn; nothing in it may have raised when it is closed."""
    page = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme).new_page()
    page.set_default_timeout(PATIENCE * 1000)
    errors: list[str] = []
    page.asked = []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(session.url)
    until(page, "window.nisus?.drawn > 0")
    yield page
    page.context.close()
    assert errors == []
