"""Run a model's own file, which is not on the import path, as a module; here or in other processes.

Functions are pickled by the name of their module, which the other process imports. The file of a model beside its
twin's YAML has no importable name; so its functions are pickled with its path, and the file is run there once.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache, partial, reduce
from importlib.machinery import PathFinder
from pathlib import Path
from pickle import PicklingError
from types import CodeType, ModuleType
from typing import Any

MARK = "~"  # Separates the name of a function from the digest of the files that its own file imports
_guarded: set[str] = set()  # Model files, and those that they import beside them


def _refuse_exit(files: tuple[Path, ...]) -> None:
    """Have `os._exit` and `os.abort` raise where a model's file calls them: they would end the program without a word.

    Child processes that a model forks still end with them.
    """
    if not _guarded:
        os._exit, os.abort = _guard(os._exit), _guard(os.abort)  # type: ignore[assignment]
    _guarded.update(map(str, files))


def _guard(function: Callable) -> Callable:
    process = os.getpid()

    def guarded(*given: object) -> object:
        if sys._getframe(1).f_code.co_filename in _guarded and os.getpid() == process:
            call = f"os.{function.__name__}({', '.join(map(repr, given))})"
            raise RuntimeError(f"{call} would end the program; a model reports an error by raising an exception")
        return function(*given)

    return guarded


OWN_PACKAGES = [Path(__file__).resolve().parents[2] / name for name in "nisus estimators sources config app".split()]


def imported_beside(path: Path) -> tuple[Path, ...]:
    """Return the files in or below a Python file's folder that it imports, directly or indirectly, by name.

    Nisus itself is none of them: beside a model in the root of a checkout stand its packages.
    """
    path, found = path.resolve(), set[Path]()
    waiting = [path]
    while waiting:
        file = waiting.pop()
        try:
            tree = ast.parse(file.read_bytes())
        except (OSError, ValueError, SyntaxError):
            continue
        for base, name in _imports(tree, file, path.parent):
            place = base.joinpath(*name.split("."))
            packages = [base.joinpath(*name.split(".")[:k], "__init__.py") for k in range(1, name.count(".") + 2)]
            for item in (place.with_suffix(".py"), *packages):
                own = any(item.is_relative_to(folder) for folder in OWN_PACKAGES)
                if item.is_file() and item != path and item not in found and not own:
                    found.add(item)
                    waiting.append(item)
    return tuple(sorted(found))


def _imports(tree: ast.Module, file: Path, top: Path) -> Iterator[tuple[Path, str]]:
    """Yield the imports of a file: the folder to search, and the dotted name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((top, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = file.parents[node.level - 1] if node.level else top
            names = [node.module] if node.module else []
            yield from (
                (base, ".".join([*names, part])) for part in ("", *(alias.name for alias in node.names)) if part
            )
            yield from ((base, name) for name in names)


def _forget(files: tuple[Path, ...]) -> None:
    """Import these files again the next time, since they may have been edited."""
    importlib.invalidate_caches()
    names = {file.name for file in files}  # to resolve the paths of thousands of modules takes 0.4 s
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file is not None and os.path.basename(file) in names and Path(file).resolve() in files:
            del sys.modules[name]


def _marked(code: CodeType, mark: str) -> CodeType:
    """Return the code with other names of its functions, so that machine code of another version is not used."""
    inner = tuple(_marked(item, mark) if isinstance(item, CodeType) else item for item in code.co_consts)
    return code.replace(co_consts=inner, co_qualname=code.co_qualname + mark)


def run_file(name: str, path: Path) -> ModuleType:
    """Run a Python file as the module `name`, with its folder importable; modules imported from there are reloaded.

    Numba caches machine code by a function's file and name, which do not change if an imported constant does. So a
    digest of the imported files becomes part of the functions' names.

    Raises:
        ImportError: If its name does not end in .py.
        BaseException: Whatever the file raises; the module is then not kept.
    """
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None:
        raise ImportError(f"{path}: it is not a Python file; its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Before it runs: dataclasses and Numba look their module up by name.
    beside = imported_beside(path)
    _forget(beside)
    _refuse_exit((path, *beside))
    sys.path.insert(0, str(path.parent))
    # No bytecode is written beside the user's files.
    before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        # Not through the loader, which would trust a stale __pycache__.
        code = compile(path.read_bytes(), str(path), "exec")
        if beside:
            digest = hashlib.sha256(b"".join(file.read_bytes() for file in beside)).hexdigest()[:8]
            code = _marked(code, MARK + digest)
        exec(code, module.__dict__)
    except BaseException:
        sys.modules.pop(name, None)
        raise
    finally:
        sys.dont_write_bytecode = before
        sys.path.remove(str(path.parent))
    return module


def portable(function: Callable) -> Callable:
    """Return the function, or one that is pickled with its file's path if its module cannot be imported by name."""
    if isinstance(function, partial):
        return partial(portable(function.func), *function.args, **function.keywords)
    name = getattr(function, "__module__", None) or ""
    file = getattr(sys.modules.get(name), "__file__", None)
    if not hasattr(function, "__qualname__") or file is None or name == "__main__" or "." in name:
        return function
    found = PathFinder.find_spec(name)
    if found is not None and found.origin is not None and Path(found.origin) == Path(file):
        return function
    return _FromFile(name, function.__qualname__.partition(MARK)[0], file, Path(file).stat().st_mtime_ns, function)


class _FromFile:
    """A function that is pickled as the path of its source, and loaded from there when it is called."""

    def __init__(self, module: str, name: str, file: str, stamp: int, function: Callable | None = None) -> None:
        self._place = module, name, file, stamp
        self._function = function

    def __call__(self, *given: object) -> object:
        if self._function is None:
            module, name, file, stamp = self._place
            self._function = _named(name, _module(module, file, stamp))
        return self._function(*given)

    def __reduce__(self) -> tuple[object, ...]:
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
    """Return the file's module in this process; with another `stamp`, its time of writing, it is run again."""
    return run_file(name, Path(file))
