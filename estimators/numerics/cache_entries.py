"""Entries of the compile cache: found by content, verified when read, compiled again when damaged.

Numba finds machine code by the path and modification time of its source file, so every checkout compiles all anew, and
reads an entry without verifying it: one truncated file ends every program that needs it. Here an entry is found by the
content of its source file and carries a checksum.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import os
import sys
from pathlib import Path
from typing import Any

import numba
from numba import config
from numba.core import bytecode, caching

ROOT = Path(__file__).resolve().parent.parent.parent
"""The folder of the packages; a file outside it, such as a user's model, is found by its path."""

ENTRY_FORMAT = 2
"""To be increased when entries that an earlier version wrote are not to be read."""

DIGEST_SIZE = hashlib.sha256().digest_size


@functools.cache
def report_damage(folder: str) -> None:
    """Print one line per process about damaged entries."""
    print(f"nisus: {folder}: damaged entries of the compile cache discarded; compiling them again", file=sys.stderr)


class ContentLocator(caching._SourceFileBackedLocatorMixin, caching._CacheLocator):  # type: ignore[misc]
    """Locates the cache of a function by the content of its source file."""

    def __init__(self, function: Any, file: str) -> None:
        path = Path(file).resolve()
        inside = path.is_relative_to(ROOT)
        folder = str(path.parent.relative_to(ROOT)) if inside else self.get_suitable_cache_subpath(file)
        self._path = os.path.join(config.CACHE_DIR, folder.replace(os.sep, "."))
        self._stamp = hashlib.sha256(path.read_bytes()).hexdigest()
        self._lineno = function.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        """Folder of the entries."""
        return self._path

    def get_source_stamp(self) -> str:
        """Digest of the source file; an entry with another one is stale."""
        return self._stamp


class EntryFiles(caching.IndexDataCacheFile):  # type: ignore[misc]
    """One file per entry, named by a digest of its key: two digests, of what it is for and of the rest, then the rest.

    Numba numbers the files and keeps the numbers in an index. Of two processes that saved the code of two closures at
    once, one lost its entry, or was given the machine code of the other.
    """

    def __init__(self, cache_path: str, filename_base: str, source_stamp: str) -> None:
        self._path_of = os.path.join(cache_path, f"{filename_base}.{{}}.nbc").format
        self._valid = ENTRY_FORMAT, numba.__version__, source_stamp

    def _path(self, key: Any) -> Path:
        return Path(self._path_of(hashlib.sha256(repr(key).encode()).hexdigest()[:16]))

    def _purpose(self, key: Any) -> bytes:
        return hashlib.sha256(repr((self._valid, key)).encode()).digest()

    def __contains__(self, key: Any) -> bool:
        """Return whether there is an entry of the present source, which takes a tenth of a millisecond."""
        try:
            with self._path(key).open("rb") as file:
                return file.read(DIGEST_SIZE) == self._purpose(key)
        except OSError:
            return False

    def save(self, key: Any, data: Any) -> None:
        """Save compiled code; of two processes that compiled the same, the last."""
        content = self._dump((key, data))
        with self._open_for_write(str(self._path(key))) as file:
            file.write(self._purpose(key) + hashlib.sha256(content).digest() + content)

    def load(self, key: Any) -> Any:
        """Return compiled code, None if there is none. A damaged file is reported and deleted."""
        path = self._path(key)
        try:
            entry = path.read_bytes()
        except OSError:
            return None
        purpose, digest, content = entry[:DIGEST_SIZE], entry[DIGEST_SIZE : 2 * DIGEST_SIZE], entry[2 * DIGEST_SIZE :]
        if hashlib.sha256(content).digest() != digest:
            report_damage(config.CACHE_DIR)
            path.unlink(missing_ok=True)
            return None
        if purpose != self._purpose(key):
            return None
        try:
            found, data = caching.pickle.loads(content)
        except ModuleNotFoundError:
            # The same file was compiled under another module name, as `runpy` and `exec` do: compile it again.
            return None
        return data if found == key else None

    def flush(self) -> None:
        """Leave the files, which are replaced as the code is compiled again."""


def use_entries() -> None:
    """Make Numba keep its cache in such entries, in this process.

    Numba tells functions of one name apart by a number that it counts from 1 in every process. So the entries of two
    closures that two processes compiled contain different functions under one symbol, and a process that loads both
    uses the first for both. Counting from a random number makes the symbols different.
    """
    bytecode.FunctionIdentity._unique_ids = itertools.count(int.from_bytes(os.urandom(6), "big"))
    caching.IndexDataCacheFile = EntryFiles
    # Numba's own locators serve functions that are in no file, as in a notebook.
    others = [found for found in caching.CompileResultCacheImpl._locator_classes if found is not ContentLocator]
    caching.CompileResultCacheImpl._locator_classes = [ContentLocator, *others]
