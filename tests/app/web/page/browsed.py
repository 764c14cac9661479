"""Sessions with a page, and waiting for its drawings."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from app.cli.open_twin import live_source
from app.web.running import OpenedTwin
from app.web.session import Page, Session
from tests.skips import with_recording
from tests.waiting import wait_for

DRAWN = "window.nisus?.drawn > 0"


def until(page: Any, expression: str) -> None:
    """Ask from outside: the page's own policy forbids the evaluation that waiting inside it would need."""

    def holds() -> object:
        try:
            return page.evaluate(expression)
        except Exception:  # noqa: BLE001  a page that is being left: there is nobody to answer
            return False

    wait_for(holds)


@contextmanager
def running(
    name: str, speed: float | None = float("inf"), *, log: Path | None = None, **overrides: str
) -> Iterator[Session]:
    """A session of a twin with its page, of a log in place of its source; played as fast as possible, it has ended."""
    twin = with_recording(name, log_files=None if log is None else [log], overrides=overrides)
    session = Session(OpenedTwin(twin, live_source(twin, speed)), page=Page(0, open_browser=False))
    session.start()
    try:
        if speed == float("inf"):
            wait_for(lambda: session.engine.status().finished)
        yield session
    finally:
        session.stop()


def settled(engine: Any, revision: int = 0) -> None:
    """Wait until a revision runs, and no refold is under way."""
    wait_for(lambda: (status := engine.status()).revision >= revision and not status.refolding)


def pixels(page: Any, selector: str, lower: float = 1.0) -> np.ndarray:
    """Return the colours of an element, (rows, columns, 3), or of its lower part."""
    from PIL import Image

    box = page.locator(selector).first.bounding_box()
    clip = box | {"y": box["y"] + (1 - lower) * box["height"], "height": lower * box["height"]}
    picture = page.screenshot(clip=clip)
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)


def drawn(page: Any, selector: str) -> dict[str, int]:
    """Return how many pixels of an element are estimate (blue) and measurement (orange)."""
    red, green, blue = np.moveaxis(pixels(page, selector), 2, 0)
    return {
        "estimate": int(np.sum((blue > 150) & (red < 90) & (green < 150))),
        "reading": int(np.sum((red > 190) & (green > 110) & (green < 180) & (blue < 80))),
    }
