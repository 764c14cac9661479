"""The few forms of Markdown that our own texts use, as HTML: headings with anchors, paragraphs, lists, tables."""

from __future__ import annotations

import re
import sysconfig
from functools import cache
from html import escape
from pathlib import Path

from estimators.diagnostics.detectors import anchor
from estimators.errors import ConfigError

BLOCK = re.compile(r"\n\s*\n")


def as_html(text: str) -> str:
    """Headings have the anchors that GitHub makes of them."""
    return "\n".join(_block(block) for block in BLOCK.split(text.strip()) if block.strip())


def _block(block: str) -> str:
    lines = block.splitlines()
    heading = re.fullmatch(r"(#+) (.+)", lines[0])
    if heading:
        level, title = len(heading[1]), heading[2]
        name = re.sub(r"[^\w -]", "", anchor(title.lower()))
        rest = "\n".join(lines[1:])
        return f'<h{level} id="{escape(name)}">{_words(title)}</h{level}>' + (f"\n{_block(rest)}" if rest else "")
    if lines[0].startswith("- "):
        items = re.split(r"^- ", block, flags=re.MULTILINE)[1:]
        return "<ul>\n" + "\n".join(f"<li>{_words(item)}</li>" for item in items) + "\n</ul>"
    if lines[0].startswith("|"):
        head, _, *rows = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]
        return f"<table>\n{_row('th', head)}\n" + "\n".join(_row("td", row) for row in rows) + "\n</table>"
    return f"<p>{_words(block)}</p>"


def _row(tag: str, cells: list[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{_words(cell)}</{tag}>" for cell in cells) + "</tr>"


def _words(text: str) -> str:
    """Render code, bold and emphasis within a line; code stays as it is."""
    parts = re.split(r"`([^`]+)`", escape(" ".join(text.split()), quote=False))
    for k, part in enumerate(parts):
        if k % 2:
            parts[k] = f"<code>{part}</code>"
        else:
            part = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", part)
            parts[k] = re.sub(r"\*(.+?)\*", r"<em>\1</em>", part)
    return "".join(parts)


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
