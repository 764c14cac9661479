"""What was given on the command line: `--set KEY=VALUE` as pairs, and numbers that are none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args, get_type_hints

from estimators.errors import ConfigError, quoted


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
