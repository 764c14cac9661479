"""What a user may choose about the scene: the page and Viser's own panel set it, the drawing thread reads it."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from estimators.errors import ConfigError

SHOW, NO_AXIS = "show", "none"
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Choice:
    """One choice: its key, its label, what there is to choose from and what is chosen at first.

    `of` is the picture that it is about; None for a choice that is always there.
    """

    key: str
    label: str
    options: tuple[str, ...]
    first: str
    of: str | None = None


class Choices:
    """The choices, and what is chosen. Any thread may ask and set."""

    def __init__(self, choices: Iterable[Choice]) -> None:
        self._choices = {choice.key: choice for choice in choices}
        self._values = {choice.key: choice.first for choice in self._choices.values()}
        self._lock = threading.Lock()

    def values(self) -> dict[str, str]:
        """What is chosen, by key."""
        with self._lock:
            return dict(self._values)

    def offered(self) -> list[Choice]:
        """The choices that there are for the picture that is shown, with more than one option each."""
        show = self.values().get(SHOW)
        return [item for item in self._choices.values() if len(item.options) > 1 and item.of in (None, show)]

    def choose(self, key: str, value: str) -> None:
        """Choose; an axis that another one has is exchanged with it.

        Raises:
            ConfigError: If there is no such choice, or nothing of that name to choose.
        """
        choice = self._choices.get(key)
        if choice is None:
            raise ConfigError(f"scene: there is no choice {key!r}; there are {', '.join(self._choices)}")
        if value not in choice.options:
            raise ConfigError(f"scene: {key} is {value!r}; it must be one of {', '.join(choice.options)}")
        with self._lock:
            if key in AXES:
                other = next((axis for axis in AXES if axis != key and self._values.get(axis) == value), None)
                if other is not None and self._values[key] in self._choices[other].options:
                    self._values[other] = self._values[key]
                elif other is not None:
                    raise ConfigError(f"scene: {value} is on the {other} axis already")
            self._values[key] = value

    def json(self) -> list[dict[str, Any]]:
        """The choices for the page, with what is chosen."""
        values = self.values()
        return [
            {"key": item.key, "label": item.label, "options": list(item.options), "value": values[item.key]}
            for item in self.offered()
        ]
