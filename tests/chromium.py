"""Chromium without a screen: where it is, and how tests, benchmarks and pictures start it."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

# The shell, the same engine without a browser's own pages and windows, takes a third of the processor for each page.
NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    "--headless=new --no-sandbox --disable-gpu --enable-unsafe-swiftshader --disable-background-networking "
    "--disable-component-update --disable-sync --no-first-run --disable-quic"
).split()


def find_chromium() -> str | None:
    """Path of a Chromium, or None."""
    given = os.environ.get("NISUS_CHROMIUM")
    found = given or next((path for name in NAMES if (path := shutil.which(name))), None)
    return found if found and Path(found).exists() else None


@contextmanager
def launched(path: str) -> Iterator[Any]:
    """The browser at that path, until the block ends."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield browser
        browser.close()
