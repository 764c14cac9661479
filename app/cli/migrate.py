"""`nisus migrate`: rewrite YAML files of the version before by the names of this one."""

from __future__ import annotations

from config.loader import find
from config.old_names import read_yaml, rewrite
from config.tunings import version_files
from config.yaml_files import read_text, shown_path
from estimators.errors import ConfigError

from ..result import JsonObject, to_json
from ..terminal import complain
from .arguments import MigrateCommand as Arguments


def migrate(arguments: Arguments) -> int:
    """Rewrite the files, and the tuning versions of those that are twins; a wrong one is left, and the rest goes on."""
    if not arguments.files:
        raise ConfigError("no file is named; give at least one")
    twins = [find(name) for name in arguments.files]
    files: list[JsonObject] = []
    status = 0
    for path in dict.fromkeys(file for twin in twins for file in (twin, *version_files(twin).values())):
        name = shown_path(path)
        try:
            _, _, places = read_yaml(read_text(path, "nisus twins"), name)
            kept = rewrite(path, lambda text: text) if places.older else None
        except ConfigError as error:
            complain(error)
            status = 2
            continue
        files.append({"file": name, "older": places.older, "kept": kept and shown_path(kept)})
        if not arguments.json:
            done = ", ".join(places.older) or "nothing to do"
            print(f"{name}: {done}" + (f"; the file as it was is {shown_path(kept)}" if kept else ""))
    if arguments.json:
        print(to_json(files))
    return status
