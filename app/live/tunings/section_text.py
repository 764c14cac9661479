"""One section of a YAML file put in place of the one that is there; the rest of the text stays as it is."""

from __future__ import annotations

import re
from pathlib import Path

from estimators.errors import ConfigError


def write_section(path: Path, key: str, section: str) -> None:
    """Put the section `key`, whole lines, into a YAML file, in place of the one that is there, or at its end.

    Raises:
        ConfigError: If the file cannot be written.
    """
    # The key and the lines under it, to the last that is indented; a comment after that belongs to what follows.
    pattern = re.compile(
        rf"^{re.escape(key)}:.*(?:\n|\Z)(?:(?:[ \t]*(?:#.*)?\r?\n)*[ \t]+[^\s#].*(?:\n|\Z))*", re.MULTILINE
    )
    try:
        with path.open(encoding="utf-8", newline="") as file:
            text = file.read()
        end = "\r\n" if "\r\n" in text else "\n"
        section = section.replace("\n", end)
        kept, found = pattern.subn(lambda _: section, text, count=1)
        path.write_text(kept if found else text.rstrip("\r\n") + 2 * end + section, encoding="utf-8", newline="")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror})") from None
