"""The folder of the compile cache. Does not import Numba, which takes long, so that an empty cache is found quickly."""

from __future__ import annotations

import ast
import hashlib
import os
from functools import cache
from importlib.metadata import version
from pathlib import Path

CONSTANTS = ("errors.py", "batch.py", "state_space.py", "detectors.py")
"""Files from which compiled code takes only constants."""

PROSE_CHARACTERS = 24
"""Strings of these files from which on are prose, an edit of which compiles nothing anew."""


def cache_folder() -> Path:
    """Return the folder of machine code: per user, and separate for each version of the sources.

    Numba checks only the file of the function that it compiles, not the files of its callees and constants. A digest of
    all sources of compiled code is therefore part of the path, so that an edit to any of them compiles everything anew.
    Bundled models are excluded, as each is compiled by itself.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "nisus" / "numba" / _digest_of_sources()


@cache
def _digest_of_sources() -> str:
    digest = hashlib.sha256(version("numba").encode())
    package = Path(__file__).parent.parent
    for path in sorted(package.rglob("*.py")):
        source = path.read_bytes()
        if path.name in CONSTANTS:
            digest.update(_without_prose(source))
        elif (b"jit" in source or b"intrinsic" in source) and package / "models" not in path.parents:
            digest.update(source)
    return digest.hexdigest()[:16]


def _without_prose(source: bytes) -> bytes:
    """Return the code of a file without its comments, docstrings and other prose."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value) >= PROSE_CHARACTERS:
            node.value = ""
    return ast.dump(tree).encode()
