"""Nisus as one import: `from nisus import fold`, `nisus.estimators`, `nisus.sources`.

An installation has all packages inside this one, so that they meet no others of their names. In a checkout they stand
beside it, and here is a second name for each; no module is loaded twice.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from multiprocessing import parent_process
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimators import *  # noqa: F403

PACKAGES = ("app", "config", "estimators", "sources")

FORMER = ("estimators", "sources")
"""Packages that models of version 0.1 import by these names."""

ROOT = Path(__file__).resolve().parents[1]

INSTALLED = (ROOT / __name__ / PACKAGES[0]).is_dir()


class SecondNames(MetaPathFinder, Loader):
    """Finds the packages of a checkout as `nisus.NAME`, and those of an installation by their former names."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """See `MetaPathFinder`."""
        return ModuleSpec(fullname, self) if first_name(fullname) else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module of the other name."""
        if not INSTALLED:
            refuse_others()
        module = import_module(first_name(spec.name))
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Give the module back its own specification; it is complete."""
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state


def first_name(name: str) -> str:
    """Return the name under which a module is loaded, of one that has two and is given by its second; else nothing."""
    first, _, rest = name.partition(".")
    if not INSTALLED:
        return rest if first == __name__ and rest.partition(".")[0] in PACKAGES else ""
    if first not in FORMER:
        return ""
    if rest:
        return f"{__name__}.{name}" if sys.modules[first] is sys.modules.get(f"{__name__}.{first}") else ""
    if PathFinder.find_spec(name) is not None:
        return ""
    if parent_process() is None:  # once for all processes of a command
        text = f"write nisus.{name} for {name}, which the next version does not find"
        warnings.warn(text, FutureWarning, stacklevel=3)
    return f"{__name__}.{name}"


@cache
def refuse_others() -> None:
    """Raise an ImportError that names the file which would be imported in the place of a package of the checkout."""
    for name in PACKAGES:
        place = getattr(find_spec(name), "origin", None) or ""
        if not Path(place).resolve().is_relative_to(ROOT / name):
            raise ImportError(f"{place} is in the place of {name} of Nisus; use an environment of its own")


def main() -> int:
    """Run the command `nisus`; what keeps it from being imported is one line."""
    try:
        command = import_module(f"{__name__}.app.cli.main").main
    except ImportError as error:
        print(f"nisus: {error}", file=sys.stderr)
        return 2
    return int(command())


sys.meta_path.insert(0, SecondNames())


def __getattr__(name: str) -> Any:
    if name.startswith("__") and name != "__all__":  # which `help` and `from nisus import *` read
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.{name}") if name in PACKAGES else getattr(import_module("nisus.estimators"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *PACKAGES, *import_module("nisus.estimators").__all__})
