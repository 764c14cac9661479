"""A twin's YAML file, read and checked; every error is one line that names file, line, value and remedy."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from estimators.errors import ConfigError, nearest

from .model_schema import kind_of
from .old_names import read_yaml, tell_older
from .problems import report, shown
from .schema import ParameterSection, TwinSection, as_gate
from .tunings import Version, find_version, keep_options, overlay
from .yaml_files import (
    TWINS,
    Key,
    ValuePlaces,
    baseline_file,
    dotted,
    parse,
    read_text,
    shipped,
    shown_path,
    with_values,
)


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


def find(name: str | os.PathLike[str]) -> Path:
    """Return the YAML file that a name (of a bundled twin) or a path means.

    Raises:
        ConfigError: If there is none.
    """
    text = os.fspath(name)
    path = Path(text).expanduser()
    if not path.name:
        raise ConfigError(f"{text}: it is a folder; give the YAML file in it")
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
    loaded = load_text(text, path, given, version, baseline_file(path))
    tell_older(loaded.places)
    return loaded


def load_text(
    text: str,
    path: Path,
    overrides: Mapping[str, str] | None = None,
    version: Version | None = None,
    baseline: Path | None = None,
) -> Loaded:
    """Check a twin's YAML that has been read already; relative paths in it start at the folder of `path`.

    The section of `baseline`, if there is such a file, is appended to the text. The values of a tuning version are put
    in place of its own, and the overrides in place of both.

    Raises:
        ConfigError: With a line for each of the first problems.
    """
    file = shown_path(path)
    text, data, places = read_yaml(text, file)
    if data is None:
        raise ConfigError(f"{file}:1: the file is empty; a twin needs at least model and source")
    if not isinstance(data, dict):
        raise ConfigError(f"{file}:1: the file is {shown(data)}; it must be a mapping of keys and values")
    if baseline is not None and baseline.is_file():
        text += _add_baseline(data, places, baseline)
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
        name = "".join(letter if letter.isalnum() or letter in "_-" else "_" for letter in path.stem) or "twin"
        config = config.model_copy(update={"name": name})
    without = None if version is None else load_text(text, path, overrides)
    return Loaded(config, path, text, places, version, without)


def _add_baseline(data: dict[str, object], places: ValuePlaces, path: Path) -> str:
    """Put the section of a baseline's file into a twin's data; return its text."""
    text, own, lines = read_yaml(read_text(path, "nisus twins"), shown_path(path))
    if not isinstance(own, dict) or set(own) != {"baseline"}:
        rule = "it must hold the section `baseline` alone; write it anew with `nisus commission --write`"
        raise ConfigError(f"{lines.file}:1: the file is {shown(own)}; {rule}")
    if "baseline" in data:
        raise ConfigError(f"{places.at(('baseline',))}: baseline stands here and in {lines.file}; keep one")
    data |= own
    places.options |= {key: lines.at(key) for key in lines.lines if key}
    return f"\n{text}"


def moved(text: str, path: Path, out: Path) -> str:
    """Return the text of a twin's YAML for a copy `out`, whose relative paths name the same files from its folder.

    Raises:
        ConfigError: If an alias shares a path with another key.
    """
    before, after = path.absolute().parent, out.absolute().parent
    if before == after:
        return text

    def there(name: str) -> str:
        return os.path.relpath(before / name, after) if not Path(name).expanduser().is_absolute() else name

    data = parse(text, shown_path(path))[0]
    changed, shared = with_values(text, dict(_paths_of(data, there, before)))
    if shared:
        remedy = "write the path out, or write the copy to the same folder"
        raise ConfigError(f"{shown_path(path)}: an alias shares {dotted(shared[0])} with another key; {remedy}")
    return changed


def _paths_of(data: Any, there: Callable[[str], str], folder: Path) -> Iterator[tuple[Key, object]]:
    """Yield key and new value of every path of a twin's data; `folder` is that of its file."""

    def file_of(reference: str) -> str:
        file, colon, name = reference.rpartition(":")
        return f"{there(file)}:{name}" if colon else reference

    def of_source(section: object, key: Key) -> Iterator[tuple[Key, object]]:
        if not isinstance(section, dict):
            return
        root = section.get("folder")
        if root is not None:
            yield (*key, "folder"), there(root)
        for name in ("files", "recording"):
            files = section.get(name)
            if files is not None and root is None:
                yield (*key, name), [there(file) for file in files] if isinstance(files, list) else there(files)
        databases = section.get("dbc")
        for k, item in enumerate(databases if isinstance(databases, list) else [databases] if databases else []):
            file = item["file"] if isinstance(item, dict) else item
            place: Key = ("dbc", k) if isinstance(databases, list) else ("dbc",)
            if root is None or not (folder / root / file).is_file():
                yield (*key, *place, *(("file",) if isinstance(item, dict) else ())), there(file)
        asset = (section.get("truth") or {}).get("model")
        if isinstance(asset, str):
            yield (*key, "truth", "model"), file_of(asset)
        yield from of_source(section.get("asset"), (*key, "asset"))
        for k, part in enumerate(section.get("parts") or ()):
            yield from of_source(part, (*key, "parts", k))

    model = data["model"]
    if kind := kind_of(model):
        yield ("model", kind), there(model[kind])
    else:
        yield ("model",), file_of(model)
    if data.get("correction") is not None:
        yield ("correction",), there(data["correction"])
    yield from of_source(data.get("source"), ("source",))


def _override(data: dict[str, object], places: ValuePlaces, dotted_key: str, text: str) -> None:
    """Put one command-line value where it belongs; the schema judges the result."""
    option = f"--set {dotted_key}={text}"
    parts = dotted_key.split(".")
    try:
        value, _ = parse(text, option)
    except ConfigError:
        raise ConfigError(f"{option}: the value is not valid YAML; put brackets and colons in quotes") from None
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
            places.give(tuple(key), option)
        elif parts[0] in ("parameters", "sensors", "inputs") and parts[k + 1] in ParameterSection.model_fields:
            # A number is the short form of a parameter, an offset or a scale.
            if isinstance(here, dict) and isinstance(here[part], int | float):
                here[part] = {"value": here[part]}
        here = here[key[-1]]
    places.give(tuple(key), option)
