"""Names in a twin's YAML beside those of its model, and values that are given once for all rows of a sensor."""

from __future__ import annotations

from typing import Any

from config.loader import Loaded
from config.yaml_lines import Key
from estimators.errors import nearest
from estimators.model.state_space import StateSpaceModel


def one_each(loaded: Loaded, key: Key, values: tuple, rows: list[str]) -> tuple:
    """A value for each row, from one for all or one each."""
    if len(values) == 1:
        return values * len(rows)
    if len(values) != len(rows):
        raise loaded.error(key, f"has {len(values)} entries; give one, or {len(rows)}: {', '.join(rows)}")
    return values


def check_names(loaded: Loaded, key: Key, given: Any, known: Any, kind: str, model: StateSpaceModel) -> None:
    """Refuse a name under `key` that the model does not have.

    Raises:
        ConfigError: With file and line, and the near names.
    """
    for name in given:
        if name not in known:
            raise loaded.error((*key, name), f"is no {kind} of {model.name}; {nearest(name, known)}")


def check_named(loaded: Loaded, key: Key, names: Any, model: StateSpaceModel) -> None:
    """Refuse a state that the value at `key` names and the model does not have.

    Raises:
        ConfigError: With file and line, and the near names.
    """
    for name in names:
        if name not in model.state_names:
            raise loaded.error(key, f"names {name!r}, no state of {model.name}; {nearest(name, model.state_names)}")
