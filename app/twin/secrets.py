"""Secrets: they stand in environment variables, whose names a YAML file has."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from config.yaml_files import Key, ValuePlaces, dotted
from estimators.errors import ConfigError

Secrets = Mapping[str, str]
"""Values of environment variables by name."""

NO_SECRETS: Secrets = {}


def secret(name: str, key: Key, places: ValuePlaces) -> str:
    """Return the value of the environment variable that a file names at a key.

    Raises:
        ConfigError: If it is not set.
    """
    value = os.environ.get(name)
    if not value:
        rule = "an environment variable that is not set; set it before the start"
        raise ConfigError(f"{places.at(key)}: {dotted(key)} is {name}, {rule}")
    return value


def secrets_of(outputs: Any, places: ValuePlaces) -> Secrets:
    """Return the values of all environment variables that the outputs of a twin or fleet name.

    Raises:
        ConfigError: If one is not set.
    """
    sections: dict[tuple[str, ...], object] = {(key,): getattr(outputs, key) for key in type(outputs).model_fields}
    sections |= {("receivers", name): section for name, section in outputs.receivers.items()}
    found: dict[str, str] = {}
    for key, section in sections.items():
        for field in ("secret_env", "password_env", "url"):
            name = getattr(section, field, None) or ""
            if field != "url" or name.startswith("$"):
                name = name.removeprefix("$")
                found |= {name: secret(name, ("outputs", *key, field), places)} if name else {}
    return found
