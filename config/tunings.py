"""Tuning versions: YAML files beside a twin's, each with the values under a name, and their scores."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from estimators.errors import ConfigError, nearest

from .companion_schema import TuningSection, VersionSection
from .old_names import tell_older
from .problems import check_section
from .yaml_files import TWINS, Key, ValuePlaces, read_text, shown_path

OWN_VALUES = "own"  # Name of the values in the twin's own file

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,59}")

SPREADS = ("variance", "std")  # Alternatives: one replaces the other


@dataclass(frozen=True)
class Version:
    """One tuning version, checked against its schema: its name, the file, its text, and the values as YAML has them."""

    name: str
    path: Path
    text: str
    data: Mapping[str, object]
    section: TuningSection
    places: ValuePlaces

    @property
    def head(self) -> VersionSection:
        """Origin and scores."""
        return self.section.version


def ships(twin: Path) -> bool:
    """Return whether a twin's YAML is one of those that ship."""
    return twin.resolve().parent == TWINS


def named(twin: Path) -> str:
    """Return a twin's YAML as the command line takes it."""
    return twin.stem if ships(twin) else shown_path(twin)


def folders(twin: Path) -> tuple[Path, ...]:
    """Return the folders of a twin's tuning versions; new ones are saved in the first.

    For a bundled twin, the user's data folder and the bundled versions; for any other, a folder beside its file.
    """
    if not ships(twin):
        return (twin.with_name(f"{twin.stem}.tunings"),)
    base = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    return (base / "nisus" / "tunings" / twin.stem, TWINS.parent / "tunings" / twin.stem)


def version_files(twin: Path) -> dict[str, Path]:
    """Return the file of each version of a twin's YAML by name; the user's own hides one of its name that ships."""
    found: dict[str, Path] = {}
    for folder in folders(twin):
        for path in sorted(folder.glob("*.yaml")):
            found.setdefault(path.stem, path)
    return found


def find_version(twin: Path, reference: str) -> Version | None:
    """Return the version of a name or path; None for the twin's own file.

    Raises:
        ConfigError: If there is none, or its file is wrong.
    """
    if reference == OWN_VALUES:
        return None
    if os.sep in reference or reference.endswith((".yaml", ".yml")):
        return load_version(Path(reference).expanduser())
    files = version_files(twin)
    if reference not in files:
        near = nearest(reference, [OWN_VALUES, *files]).rstrip("?")
        raise ConfigError(
            f"--tuning {reference}: {twin.stem} has no such version; {near}; see `nisus tunings {named(twin)}`"
        )
    return load_version(files[reference])


def load_version(path: Path) -> Version:
    """Read and check a version's file.

    Raises:
        ConfigError: With a line for each of the first problems.
    """
    version = version_of(path.stem, read_text(path, "nisus tunings TWIN"), path)
    tell_older(version.places)
    return version


def version_of(name: str, text: str, path: Path) -> Version:
    """Check a version that has been read already; raises as `load_version`."""
    rule = "a tuning version is a mapping that begins with `version:`"
    section, data, places = check_section(TuningSection, text, path, rule)
    return Version(name, path, text, data, section, places)


def check_name(name: str) -> str:
    """Return a name under which a version can be kept.

    Raises:
        ConfigError: If it is none.
    """
    if not NAME.fullmatch(name) or name == OWN_VALUES or name.endswith((".yaml", ".yml")):
        raise ConfigError(
            f"the version's name is {name!r}; use letters, digits, _, - and ., 60 at most, begin with a letter or "
            f"digit, and neither `{OWN_VALUES}` nor an ending"
        )
    return name


def overlay(data: dict[str, object], places: ValuePlaces, version: Version) -> None:
    """Put a version's values in place of a twin's; errors about them name the version's file and line.

    Entries are replaced one by one, so that those which a version lacks stay (limits of a sensor, another filter's
    options); estimator, gate and baseline are replaced as a whole.
    """
    given = {key: value for key, value in version.data.items() if key != "version"}
    if "estimator" in given and given["estimator"] is not None:
        keep_options(data, places)
        filters, name = data.get("filters"), version.section.estimator
        if isinstance(filters, dict) and name is not None:
            data["filters"] = {key: value for key, value in filters.items() if key != name.name}
    for key, value in given.items():
        if key in ("estimator", "gate", "baseline") or not isinstance(value, dict):
            if value is not None or key == "gate":
                data[key] = value
                _placed(places, (key,), version)
        else:
            _merge(data, (key,), value, places, version)


def _merge(data: dict[str, object], key: Key, value: dict[str, object], places: ValuePlaces, version: Version) -> None:
    own = data.get(str(key[-1]))
    if not isinstance(own, dict):
        # A parameter of the twin may be a number, to which the version adds a width.
        own = {"value": own} if key[0] == "parameters" and own is not None else {}
        places.options[key] = version.places.at(key)
    own = {name: item for name, item in own.items() if name not in SPREADS} if set(value) & set(SPREADS) else dict(own)
    data[str(key[-1])] = own
    for name, item in value.items():
        if isinstance(item, dict):
            _merge(own, (*key, name), item, places, version)
        else:
            own[name] = item
            _placed(places, (*key, name), version)


def _placed(places: ValuePlaces, key: Key, version: Version) -> None:
    for inner in [inner for inner in version.places.lines if inner[: len(key)] == key]:
        places.options[inner] = version.places.at(inner)


def keep_options(data: dict[str, object], places: ValuePlaces) -> None:
    """Move the options of the YAML's own filter to `filters`, before another name takes its place.

    So they are there when that filter runs after all: named on the command line, chosen on the page, or compared.
    """
    own, filters = data.get("estimator"), data.get("filters") or {}
    if not isinstance(own, dict) or not isinstance(filters, dict):
        return
    name, options = own.get("name"), own.get("options")
    given = filters.get(name) if isinstance(name, str) else None
    if not isinstance(name, str) or not isinstance(options, dict) or not isinstance(given, dict | None):
        return
    data["filters"] = {**filters, name: {**(given or {}), **options}}
    data["estimator"] = {key: value for key, value in own.items() if key != "options"}
    moved: Any
    for moved in (places.lines, places.options):
        for key in [key for key in moved if key[:2] == ("estimator", "options")]:
            moved[("filters", name, *key[2:])] = moved[key]
