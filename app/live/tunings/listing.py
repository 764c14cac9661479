"""The tuning versions of a twin, as the command line and the page list them."""

from __future__ import annotations

from typing import Any

from config.tunings import OWN, Version, load_version, version_files
from estimators.errors import ConfigError

from ...twin.twin import Twin


def listing(twin: Twin) -> list[dict[str, Any]]:
    """What the twin's file says, then its versions as they were saved, the oldest first.

    Each has `name`, `estimator`, `holds` (whether guards go by it) and what its file says of it; one that cannot be
    read has `name` and `error`.
    """
    versions: list[Version] = []
    broken: list[dict[str, Any]] = []
    for name, path in version_files(twin.path).items():
        try:
            versions.append(load_version(path))
        except ConfigError as error:
            broken.append({"name": name, "error": str(error)})
    versions.sort(key=lambda version: (version.head.saved, version.name))
    accepted = max((v.head.accepted.at for v in versions if v.head.accepted is not None), default=None)
    own = twin.loaded.without or twin.loaded
    found: list[dict[str, Any]] = [{"name": OWN, "estimator": own.config.estimator.name, "holds": accepted is None}]
    for version in versions:
        estimator = version.section.estimator or own.config.estimator
        holds = version.head.accepted is not None and version.head.accepted.at == accepted
        head = version.head.model_dump(mode="json")
        found.append({"name": version.name, "estimator": estimator.name, "holds": holds, **head})
    return found + broken
