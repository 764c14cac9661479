"""Compilation of the plain Python functions that a model's function calls.

Numba compiles a function, but calls only functions that are compiled already. A function is therefore built again from
the same code, with compiled functions in place of the plain ones in its globals and closure.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CellType, CodeType, FunctionType
from typing import Any
from uuid import UUID

from numba.core.serialize import dumps

from .jit import Inner, inner, plain

LIBRARIES = ("numpy", "scipy", "numba", "math", "cmath")
"""Packages whose functions Numba supports itself, or not at all."""


def with_helpers(function: Callable) -> Callable:
    """Return the function if it calls no plain ones, else a copy that calls them compiled.

    Numba caches machine code by a function's file, line and name, and ignores other files. A digest of the callees'
    sources is therefore part of the new name.
    """
    return _with_helpers(function, {})


def _with_helpers(function: Callable, known: dict[Callable, Callable]) -> Callable:
    if not isinstance(function, FunctionType):
        return function
    used = {name: function.__globals__[name] for name in _names(function.__code__) if name in function.__globals__}
    helpers = {name: item for name, item in used.items() if _plain(item) and item is not function}
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    enclosed = [item for item in cells if _plain(item) and item is not function]
    if not helpers and not enclosed:
        return function
    world = dict(function.__globals__)
    closure = tuple(CellType(item) for item in cells) if cells else None
    made = FunctionType(function.__code__, world, function.__name__, function.__defaults__, closure)
    made.__kwdefaults__, made.__module__ = function.__kwdefaults__, function.__module__
    made.__qualname__ = f"{function.__qualname__}_{source_digest([*helpers.values(), *enclosed])[:12]}"
    for name, item in helpers.items():
        world[name] = compiled(item, known)
    for cell, item in zip(closure or (), cells, strict=True):
        if item in enclosed:
            cell.cell_contents = compiled(item, known)
    return made


def compiled(helper: Callable, known: dict[Callable, Any], forceinline: bool = False) -> Inner:
    """Return a function compiled for compiled callers, under an identifier by which the cache finds them again.

    Numba distinguishes closures by their content, a compiled function by an identifier that is random by default: one
    made from the source, and from the values that it encloses, finds the code that another process compiled.
    """
    if helper not in known:
        # Registered first, so that a function that calls itself through its helpers does not recurse forever.
        known[helper] = helper
        known[helper] = inner(_with_helpers(helper, known), forceinline)
        known[helper]._set_uuid(str(UUID(source_digest([helper])[:32])))
    return known[helper]


def _plain(item: object) -> bool:
    if not isinstance(item, FunctionType) or item.__module__ == plain.__module__:
        # Those of jit.py Numba knows, some by an implementation of its own.
        return False
    return str(item.__module__).split(".")[0] not in LIBRARIES


def _names(code: CodeType) -> Iterator[str]:
    """Yield the names that the code and its nested functions look up."""
    yield from code.co_names
    for item in code.co_consts:
        if isinstance(item, CodeType):
            yield from _names(item)


def source_digest(helpers: list[Any]) -> str:
    """Return a digest of helpers and all their callees: their sources, enclosed values and defaults."""
    digest = hashlib.sha256()
    seen: list[object] = []
    while helpers:
        helper = helpers.pop()
        if helper in seen:
            continue
        seen.append(helper)
        path = Path(helper.__code__.co_filename)
        digest.update(helper.__qualname__.encode() + helper.__code__.co_code)
        digest.update(path.read_bytes() if path.is_file() else repr(helper.__code__.co_consts).encode())
        names = [helper.__globals__.get(name) for name in _names(helper.__code__)]
        helpers += [item for item in names if _plain(item)]
        cells = [cell.cell_contents for cell in helper.__closure__ or ()]
        functions = [plain(item) for item in cells if _plain(plain(item))]
        helpers += functions
        values = [item for item in cells if not _plain(plain(item))]
        digest.update(dumps((values, helper.__defaults__, helper.__kwdefaults__)))
    return digest.hexdigest()
