"""A tuning version written: what a fit found, what a run had, or what the command line says."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from config.files import shown_path
from config.tuning_schema import AcceptedSection, EvidenceSection, VersionSection
from config.tunings import Version, check_name, folders, load_version, version_of
from config.yaml_text import as_section
from estimators.errors import ConfigError
from estimators.tuning import Tuning

from ...twin.twin import Twin
from ..runs.tuning_yaml import tuning_yaml
from .section_text import write_section

DIGITS = 8
"""Significant digits of a score: what other processors make of it differs far behind them."""


@dataclass(frozen=True)
class Settings:
    """What a version is made of: the filter, the tuning, and what is known of them.

    `prior` has mean and std by state where that was fitted; `scores` are those of `figures`; `evidence` is why a fit
    proposed it.
    """

    estimator: str
    tuning: Tuning
    note: str = ""
    fitted_on: Sequence[str] = ()
    scores: Mapping[str, float] = field(default_factory=dict)
    prior: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    model_version: int = 1
    evidence: EvidenceSection | None = None


def version_text(twin: Twin, given: Settings) -> str:
    """The YAML of a version."""
    head = VersionSection(
        twin=twin.name,
        model=twin.model.name,
        model_version=given.model_version,
        saved=now(),
        note=given.note,
        fitted_on=tuple(given.fitted_on),
        scores={name: float(f"{value:.{DIGITS}g}") for name, value in given.scores.items()},
        evidence=given.evidence,
    )
    heading = f"# A tuning version of {twin.name}; `nisus tunings` lists, compares and accepts them.\n"
    normal = {}
    if given.tuning.baseline is not None:
        normal = {
            name: section.model_dump(mode="json", exclude_unset=True)
            for name, section in twin.config.commissioned.items()
        }
    more = [*as_section("prior", given.prior), *as_section("commissioned", normal)]
    values = tuning_yaml(twin.config, given.estimator, given.tuning, whole=False)
    return heading + _header(head) + values + "".join(f"{line}\n" for line in more)


def check_free(twin: Path, name: str) -> Path:
    """The file that a version of this name would have, of a twin's YAML.

    Raises:
        ConfigError: If the name is none or taken.
    """
    path = folders(twin)[0] / f"{check_name(name)}.yaml"
    if path.exists():
        raise _taken(path)
    return path


def _taken(path: Path) -> ConfigError:
    return ConfigError(f"{shown_path(path)}: there is a version of that name; choose another name")


def keep(twin: Twin, name: str, text: str) -> Path:
    """Write a version beside its twin.

    Returns:
        The file.

    Raises:
        ConfigError: If the name is none or taken, the text is wrong, or the file cannot be written.
    """
    path = check_free(twin.path, name)
    version_of(name, text, path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise _taken(path) from None
    except OSError as error:
        raise ConfigError(f"{shown_path(path)}: {error.strerror}; the version cannot be written there") from None
    return path


def accept(version: Version, note: str) -> None:
    """Note in a version's file that it is accepted; raises as `write_section`."""
    head = version.head.model_copy(update={"accepted": AcceptedSection(at=now(), note=note)})
    write_section(version.path, "version", _header(head))
    load_version(version.path)


def now() -> str:
    """The present time, as versions have it."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def _header(head: VersionSection) -> str:
    given = head.model_dump(mode="json", exclude_defaults=True)
    return "".join(f"{line}\n" for line in as_section("version", given))
