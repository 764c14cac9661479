"""Where a command writes: refused before its work, not after."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import get_args, get_type_hints

from estimators.errors import ConfigError, quoted


def check_output(option: str, path: Path) -> None:
    """Refuse a file that could not be written, before the work of minutes that it is to keep.

    Raises:
        ConfigError: If it is a folder, or its folder is not there or lets nobody write.
    """
    folder = path.absolute().parent
    if path.is_dir():
        raise ConfigError(f"{option} {path}: is a folder; name a file in it")
    if not folder.is_dir():
        raise ConfigError(f"{option} {path}: there is no folder {path.parent}; make it first")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise ConfigError(f"{option} {path}: cannot be written; check the permissions")


def settings(given: Sequence[str], estimator: str | None = None, tuning: str | None = None) -> dict[str, str]:
    """The KEY=VALUE pairs of `--set`, with `--estimator` and `--tuning` as two more.

    Raises:
        ConfigError: If one has no `=`, or no key before it.
    """
    pairs: dict[str, str] = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            lacks = "key" if equals else "value"
            raise ConfigError(f"--set {text}: has no {lacks}; write KEY=VALUE, for example --set R.winding=9")
        pairs[key.strip()] = value.strip()
    if estimator is not None:
        pairs["estimator"] = estimator
    if tuning is not None:
        pairs["tuning"] = tuning
    return pairs


def check_numbers(command: type, words: Sequence[str]) -> None:
    """Refuse what is no number where an option takes one; tyro would tell what Python said of it, in a frame.

    Raises:
        ConfigError: With the option and the value.
    """
    hints = get_type_hints(command)
    for word, after in zip(words, [*words[1:], ""], strict=False):
        option, equals, given = word.partition("=")
        value = given if equals else after
        hint = hints.get(option.removeprefix("--").replace("-", "_")) if option.startswith("--") else None
        number = next((kind for kind in (hint, *get_args(hint)) if kind in (int, float)), None)
        if number is None or value in ("", "None") or value.startswith("--"):
            continue
        try:
            number(value)
        except ValueError:
            what = "a whole number" if number is int else "a number"
            raise ConfigError(f"{option} {quoted(value)}: must be {what}") from None
