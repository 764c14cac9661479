"""`nisus migrate`: rewrite YAML files of the version before by the names of this one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from config.loader import find
from config.old_names import read_yaml, rewrite
from config.tunings import version_files
from config.yaml_files import read_text, shown_path

from ..result import to_json

if TYPE_CHECKING:
    from .arguments import MigrateCommand as Arguments


def migrate(arguments: Arguments) -> int:
    """Rewrite the files, and the tuning versions of those that are twins."""
    twins = [find(name) for name in arguments.files]
    files: list[dict[str, Any]] = []
    for path in dict.fromkeys(file for twin in twins for file in (twin, *version_files(twin).values())):
        name = shown_path(path)
        _, _, places = read_yaml(read_text(path, "nisus twins"), name)
        kept = rewrite(path, lambda text: text) if places.older else None
        files.append({"file": name, "older": places.older, "kept": kept and shown_path(kept)})
    if arguments.json:
        print(to_json(files))
        return 0
    for item in files:
        done = f"{', '.join(item['older'])}; the file as it was is {item['kept']}" if item["kept"] else "nothing to do"
        print(f"{item['file']}: {done}")
    return 0
