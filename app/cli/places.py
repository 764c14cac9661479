"""Where a command writes: refused before its work, not after."""

from __future__ import annotations

import os
from pathlib import Path

from estimators.errors import ConfigError


def check_place(option: str, path: Path) -> None:
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
