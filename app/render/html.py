"""Results as one HTML page."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

from estimators.errors import digits

from ..result import WORSE, Topic

if TYPE_CHECKING:
    from jinja2 import Template


def to_html(title: str, topics: Sequence[Topic], *, now: float | None = None) -> str:
    """Return one HTML page that needs no other file.

    The first topic is the head of the page. `now` is the time of writing, s since 1970, UTC; None means now.
    """
    return _page().render(title=title, topics=topics, stamp=stamp(now))


def stamp(now: float | None = None) -> str:
    """Return the version of Nisus and the time of writing."""
    try:
        own = f" {version('nisus')}"
    except PackageNotFoundError:
        own = ""
    return f"Nisus{own}, {time.strftime('%d %B %Y, %H:%M UTC', time.gmtime(now))}"


@cache
def _page() -> Template:
    """Return the template; scripts and styles are in the page, which forbids to load anything from elsewhere."""
    from jinja2 import Environment, StrictUndefined

    found = Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, undefined=StrictUndefined
    )
    found.tests["finite"] = math.isfinite
    found.filters["shown"] = lambda figure: (figure.name, figure.text())
    found.globals.update(digits=digits, WORSE=WORSE)
    return found.from_string(Path(__file__).with_name("result.html").read_text(encoding="utf-8"))
