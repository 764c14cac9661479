"""docs/alarms.md, as it is read beside the page: each cause with what usually is behind it, and how to respond."""

from __future__ import annotations

import re
import sysconfig
from functools import cache
from pathlib import Path

from estimators.diagnostics.episodes import anchor
from estimators.errors import ConfigError

NAME = "docs/alarms.md"

PLACES = (
    Path(__file__).resolve().parents[3] / NAME,
    Path(sysconfig.get_path("data")) / "share" / "nisus" / Path(NAME).name,
)
"""Beside the packages, or where an installation puts it."""


@cache
def alarms_text() -> str:
    """The whole file.

    Raises:
        ConfigError: If it is not there.
    """
    for path in PLACES:
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise ConfigError(f"{NAME} is not where it was installed; install Nisus again")


def advice(cause: str, label: str) -> str:
    """What is said of a cause under a label such as "Response"; "" if nothing is."""
    try:
        sections = re.split(r"^#+ ", alarms_text(), flags=re.MULTILINE)
    except ConfigError:
        return ""
    own = next((text for text in sections if anchor(text.partition("\n")[0].strip().lower()) == anchor(cause)), "")
    found = re.search(
        rf"^- \*\*{re.escape(label)}:\*\* (.*?)(?=^- \*\*|^\S(?!\*)|\n\n|\Z)", own, re.MULTILINE | re.DOTALL
    )
    return re.sub(r"[*`]", "", " ".join(found[1].split())) if found else ""
