"""The guide to alarms, as a page of HTML and as answers on one cause."""

from __future__ import annotations

import re
import sysconfig
from functools import cache
from itertools import pairwise
from pathlib import Path

from estimators.diagnostics.detectors import anchor
from estimators.errors import ConfigError


def as_html(text: str) -> str:
    """Headings have the anchors that GitHub makes of them."""
    from markdown_it import MarkdownIt

    # Links lead to other guides, which are not served.
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table").disable("link")
    tokens = markdown.parse(text)
    for heading, title in pairwise(tokens):
        if heading.type == "heading_open":
            heading.attrSet("id", re.sub(r"[^\w -]", "", anchor(title.content.lower())))
    return str(markdown.renderer.render(tokens, markdown.options, {}))


NAME = "docs/alarms.md"

PLACES = (
    Path(__file__).resolve().parents[3] / NAME,
    Path(sysconfig.get_path("data")) / "share" / "nisus" / Path(NAME).name,
)
"""In the checkout, or where an installation puts it."""


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
    """Return the text of a cause under a label such as "Response"; "" without one."""
    try:
        sections = re.split(r"^#+ ", alarms_text(), flags=re.MULTILINE)
    except ConfigError:
        return ""
    own = next((text for text in sections if anchor(text.partition("\n")[0].strip().lower()) == anchor(cause)), "")
    found = re.search(
        rf"^- \*\*{re.escape(label)}:\*\* (.*?)(?=^- \*\*|^\S(?!\*)|\n\n|\Z)", own, re.MULTILINE | re.DOTALL
    )
    return re.sub(r"[*`]", "", " ".join(found[1].split())) if found else ""
