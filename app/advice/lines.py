"""An advice as lines of a twin's YAML, and put there."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

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


def changed(text: str, section: str) -> str:
    """A YAML's text with the section `estimator` in place of the one that is there, or at its end."""
    end = "\r\n" if "\r\n" in text else "\n"
    plain = text.replace("\r\n", "\n")
    if plain and not plain.endswith("\n"):
        plain += "\n"
    found, count = ESTIMATOR.subn(lambda _: section, plain, count=1)
    return (found if count else plain + "\n" + section).replace("\n", end)


def apply(path: Path, section: str, out: Path | None = None) -> Path | None:
    """Write the YAML with that section to `out`, or over itself.

    Returns:
        The copy of the file as it was, beside it; None where `out` was written.

    Raises:
        ConfigError: If it cannot be written.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            text = changed(file.read(), section)
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
