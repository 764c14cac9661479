"""A twin's YAML file, read and checked; every error is one line that names file, line, value and remedy."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from estimators.errors import ConfigError, nearest

from .problems import report, shown
from .schema import TwinSection, as_gate
from .tunings import Version, find_version, keep_options, overlay
from .yaml_files import Key, ValuePlaces, dotted, parse, read_text, shown_path

TWINS = Path(str(resources.files("config"))) / "twins"  # Folder of the twins that ship


@dataclass(frozen=True)
class Loaded:
    """A twin's checked configuration, the text it came from, and the place of each of its values.

    `version` is the tuning version whose values replace those of the text, and `without` the same file without them:
    a tuning must not change the simulated asset. None if there is none.
    """

    config: TwinSection
    path: Path
    text: str
    places: ValuePlaces
    version: Version | None = None
    without: Loaded | None = None

    def error(self, key: Key, text: str) -> ConfigError:
        """Return an error about the value at `key`, which `text` goes on to describe."""
        return ConfigError(f"{self.places.at(key)}: {dotted(key)} {text}")


def shipped() -> list[str]:
    """Return the names of the bundled twins."""
    return sorted(path.stem for path in TWINS.glob("*.yaml"))


def find(name: str | os.PathLike[str]) -> Path:
    """Return the YAML file that a name (of a bundled twin) or a path means.

    Raises:
        ConfigError: If there is none.
    """
    text = os.fspath(name)
    path = Path(text).expanduser()
    if path.suffix not in (".yaml", ".yml") and os.sep not in text:
        if text in shipped():
            return TWINS / f"{text}.yaml"
        if path.with_suffix(".yaml").is_file():
            return path.with_suffix(".yaml")
        raise ConfigError(
            f"{text}: no twin of that name ships; {nearest(text, shipped()).rstrip('?')}, give a YAML file's "
            f"path, or write one with `nisus new {text}`"
        )
    return path


def load(name: str | os.PathLike[str], overrides: Mapping[str, str] | None = None) -> Loaded:
    """Read and check a twin's YAML.

    Args:
        name: Name of a twin that ships, or path of a YAML file.
        overrides: Values by dotted key path (source.interface), as YAML text, which replace the file's; under `tuning`
            the name or path of a tuning version, whose values they replace too.

    Raises:
        ConfigError: With a line for each of the first problems.
    """
    path = find(name)
    text = read_text(path, "nisus twins")
    given = dict(overrides or {})
    reference = given.pop("tuning", None)
    version = None if reference is None else find_version(path, reference)
    return load_text(text, path, given, version)


def load_text(
    text: str, path: Path, overrides: Mapping[str, str] | None = None, version: Version | None = None
) -> Loaded:
    """Check a twin's YAML that has been read already; relative paths in it start at the folder of `path`.

    The values of a tuning version are put in place of its own, and the overrides in place of both.

    Raises:
        ConfigError: With a line for each of the first problems.
    """
    file = shown_path(path)
    data, places = parse(text, file)
    if data is None:
        raise ConfigError(f"{file}:1: the file is empty; a twin needs at least model and source")
    if not isinstance(data, dict):
        raise ConfigError(f"{file}:1: the file is {shown(data)}; it must be a mapping of keys and values")
    if version is not None:
        overlay(data, places, version)
    # First what is named as a whole, then what is in it: a filter, then its options.
    for key, value in sorted((overrides or {}).items(), key=lambda item: item[0].count(".")):
        _override(data, places, key, value)
    try:
        config = TwinSection.model_validate(data)
    except ValidationError as error:
        raise report(error, data, places) from None
    if config.name is None:
        config = config.model_copy(update={"name": _name(path)})
    without = None if version is None else load_text(text, path, overrides)
    return Loaded(config, path, text, places, version, without)


def _name(path: Path) -> str:
    return "".join(letter if letter.isalnum() or letter in "_-" else "_" for letter in path.stem) or "twin"


def _override(data: dict[str, Any], places: ValuePlaces, dotted_key: str, text: str) -> None:
    """Put one command-line value where it belongs; the schema judges the result."""
    option = f"--set {dotted_key}={text}"
    try:
        value, _ = parse(text, option)
    except ConfigError:
        raise ConfigError(f"{option}: the value is not valid YAML; put brackets and colons in quotes") from None
    parts = dotted_key.split(".")
    if parts[0] == "estimator" and len(parts) > 1 and isinstance(data.get("estimator"), str):
        data["estimator"] = {"name": data["estimator"]}
    if parts[0] == "gate" and len(parts) > 1:
        data["gate"] = as_gate(data.get("gate"))
    if parts in (["estimator"], ["estimator", "name"]):
        keep_options(data, places)
    if not all(parts):
        raise ConfigError(f"{option}: the key has an empty part; write it like source.interface")
    key: list[str | int] = []
    here: Any = data
    for k, part in enumerate(parts):
        if isinstance(here, list):
            if not part.isdecimal() or int(part) >= len(here):
                raise ConfigError(
                    f"{option}: {dotted(tuple(key))} is a list; choose an entry from 0 to {len(here) - 1}"
                )
            key.append(int(part))
        elif isinstance(here, dict):
            key.append(part)
        else:
            raise ConfigError(f"{option}: {dotted(tuple(key))} is {shown(here)}; it has no key {part!r}")
        if k == len(parts) - 1:
            here[key[-1]] = value
        elif isinstance(here, dict) and here.get(part) is None:
            here[part] = {}
            places.options[tuple(key)] = option
        here = here[key[-1]]
    places.options[tuple(key)] = option
