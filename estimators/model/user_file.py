"""Functions of a model's own file, which lies where Python does not look: run under a name, here or in other processes.

What goes to another process goes by the name of its module, which that process then imports. A model beside its twin's
YAML has no such name; so its functions go with the path of their file, which is run there under the same name, once.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from functools import lru_cache, partial, reduce
from importlib.machinery import PathFinder
from pathlib import Path
from pickle import PicklingError
from types import ModuleType
from typing import Any


def run_file(name: str, path: Path) -> ModuleType:
    """Run a Python file as the module `name`, with its folder importable meanwhile.

    Raises:
        ImportError: If its name does not end in .py.
        BaseException: Whatever the file raises; the module is then not kept.
    """
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None:
        raise ImportError(f"{path}: it is not a Python file; its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Before it runs: dataclasses and Numba look their module up by name.
    sys.path.insert(0, str(path.parent))
    # Nothing is left beside the user's files, by those that this one imports either.
    before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        # Not through the loader, which would trust a stale __pycache__.
        exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)
    except BaseException:
        sys.modules.pop(name, None)
        raise
    finally:
        sys.dont_write_bytecode = before
        sys.path.remove(str(path.parent))
    return module


def portable(function: Callable) -> Callable:
    """The function, or, if Python does not find its module by name, one that is pickled with the path of its file."""
    if isinstance(function, partial):
        return partial(portable(function.func), *function.args, **function.keywords)
    name = getattr(function, "__module__", None) or ""
    file = getattr(sys.modules.get(name), "__file__", None)
    if not hasattr(function, "__qualname__") or file is None or name == "__main__" or "." in name:
        return function
    found = PathFinder.find_spec(name)
    if found is not None and found.origin is not None and Path(found.origin) == Path(file):
        return function
    return _FromFile(name, function.__qualname__, file, Path(file).stat().st_mtime_ns, function)


class _FromFile:
    """A function that is pickled as the place of its source, and found there when it is called."""

    def __init__(self, module: str, name: str, file: str, stamp: int, function: Callable | None = None) -> None:
        self._place = module, name, file, stamp
        self._function = function

    def __call__(self, *given: Any) -> Any:
        if self._function is None:
            module, name, file, stamp = self._place
            self._function = _named(name, _module(module, file, stamp))
        return self._function(*given)

    def __reduce__(self) -> tuple[Any, ...]:
        module, name, _, _ = self._place
        try:
            same = _named(name, sys.modules[module]) is self._function
        except AttributeError:
            same = False
        if not same:
            raise PicklingError(f"{name} is not what {module} has under that name")
        return _FromFile, self._place


def _named(name: str, module: ModuleType) -> Any:
    return reduce(getattr, name.split("."), module)


@lru_cache(maxsize=32)
def _module(name: str, file: str, stamp: int) -> ModuleType:
    """The file's module in this process; `stamp`, when the file was written, runs one that was edited again."""
    return run_file(name, Path(file))
