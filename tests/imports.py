"""The modules of the checkout and their imports, read from the sources without importing anything."""

import ast
from functools import cache
from pathlib import Path

from tests import ROOT

PACKAGES = ("app", "sources", "estimators", "config")


def imported(source: str, package: str) -> list[str]:
    """Return every module that a source imports, anywhere in it, with relative names made absolute."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parts, *([node.module] if node.module else [])])
            # `from package import name` may import a module of that name, so the name counts too.
            found += [f"{base}.{alias.name}" for alias in node.names]
    return found


def modules(*packages: str, root: Path = ROOT) -> dict[str, Path]:
    """Return the file of every module by its name; without packages, those of the product."""
    found = {}
    for path in sorted(path for package in packages or PACKAGES for path in (root / package).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def edges(*packages: str, root: Path = ROOT) -> dict[str, set[str]]:
    """Return the modules that every module imports: at the top, in a function, or for its types only."""
    names = modules(*packages, root=root)
    found: dict[str, set[str]] = {}
    for name, path in names.items():
        package = ".".join(path.relative_to(root).parent.parts)
        found[name] = set()
        for item in imported(path.read_text(encoding="utf-8"), package):
            candidates = [item, item.rpartition(".")[0]]
            found[name] |= {next((known for known in candidates if known in names), name)} - {name}
    return found
