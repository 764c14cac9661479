"""An advice as lines of a twin's YAML, and put there."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from config.tunings import SPREADS
from config.yaml_lines import parse
from config.yaml_text import as_flow
from estimators.errors import ConfigError
from estimators.registry import find_entry

from .verdict import Advice

ESTIMATOR = re.compile(r"^estimator[ \t]*:[^\n]*\n(?:(?:[ \t]*\n)*[ \t]+\S[^\n]*\n)*", re.MULTILINE)
"""The section of the YAML: its line, and the indented ones below."""


def lines(advice: Advice) -> str:
    """The section `estimator`, with the options that were found."""
    why = ", ".join(advice.because)
    if not advice.options:
        return f"estimator: {advice.estimator}  # nisus advise: by {why}\n"
    options = ", ".join(f"{name}: {_word(advice, name, value)}" for name, value in advice.options.items())
    return (
        f"estimator:                       # nisus advise: by {why}\n"
        f"  name: {advice.estimator}\n  options: {{{options}}}\n"
    )


def _word(advice: Advice, name: str, value: float) -> str:
    """A value as YAML reads it: of a choice its word."""
    option = next(option for option in find_entry(advice.estimator).options if option.name == name)
    return str(option.choices[round(value)]) if option.choices else f"{value:.4g}"


def lasting_lines(advice: Advice) -> str:
    """The entries of `noise` and `sensors` that say which errors last; empty if none does."""
    found: dict[str, list[str]] = {}
    for key, entry in advice.sections.items():
        group, _, name = key.partition(".")
        found.setdefault(group, []).append(f"  {name}: {as_flow(entry)}\n")
    return "".join(f"{group}:\n{''.join(entries)}" for group, entries in found.items())


def with_entry(text: str, key: str, entry: Mapping[str, Any]) -> str:
    """A YAML's text in which `GROUP.NAME` says this too; what else it said stays, its comments do not.

    Raises:
        ConfigError: If the group is not written with a line for each of its names.
    """
    group, _, name = key.partition(".")
    data = parse(text, "the YAML")[0][group] if re.search(rf"^{group}[ \t]*:", text, re.MULTILINE) else {}
    own = (data or {}).get(name) or {}
    # Its white noise is another once part of it lasts.
    merged = {**{word: value for word, value in own.items() if word not in SPREADS}, **entry}
    line = f"{name}: {as_flow(merged)}\n"
    if not data:
        return f"{text}\n{group}:\n  {line}"
    head = re.search(rf"^{group}[ \t]*:[ \t]*(#[^\n]*)?\n", text, re.MULTILINE)
    if head is None:
        raise ConfigError(f"{group}: is written in one line; put {name}: {as_flow(merged)} in by hand")
    here = re.compile(rf"^([ \t]+)([\"']?){re.escape(name)}\2[ \t]*:[^\n]*\n(?:\1[ \t]+\S[^\n]*\n)*", re.MULTILINE)
    found = here.search(text, head.end()) if name in data else None
    if found is None:
        first = re.compile(r"[ \t]*").match(text, head.end())
        indent = (first.group() if first else "") or "  "
        return text[: head.end()] + indent + line + text[head.end() :]
    return text[: found.start()] + found.group(1) + line + text[found.end() :]


def changed(text: str, section: str, entries: Mapping[str, Mapping[str, Any]] | None = None) -> str:
    """A YAML's text with the section `estimator` in place of the one that is there, or at its end; and entries."""
    end = "\r\n" if "\r\n" in text else "\n"
    plain = text.replace("\r\n", "\n")
    if plain and not plain.endswith("\n"):
        plain += "\n"
    found, count = ESTIMATOR.subn(lambda _: section, plain, count=1)
    plain = found if count else plain + "\n" + section
    for key, entry in (entries or {}).items():
        plain = with_entry(plain, key, entry)
    return plain.replace("\n", end)


def apply(
    path: Path, section: str, out: Path | None = None, entries: Mapping[str, Mapping[str, Any]] | None = None
) -> Path | None:
    """Write the YAML with that section, and these entries, to `out`, or over itself.

    Returns:
        The copy of the file as it was, beside it; None where `out` was written.

    Raises:
        ConfigError: If it cannot be written.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            text = changed(file.read(), section, entries)
        if out is None:
            kept = _free(path)
            shutil.copy2(path, kept)
        else:
            kept = None
        (out or path).write_text(text, encoding="utf-8", newline="")
    except OSError as error:
        raise ConfigError(f"{out or path}: cannot be written ({error.strerror})") from None
    return kept


def _free(path: Path) -> Path:
    """A name beside a file that no other has: pump.1.yaml.bak."""
    k = 1
    while (copy := path.with_name(f"{path.name}.{k}.bak")).exists():
        k += 1
    return copy
