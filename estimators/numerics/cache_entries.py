"""Entries of the compile cache: found by content, verified when read, compiled again when damaged.

Numba finds machine code by the path and modification time of its source file, so every checkout compiles all anew, and
reads an entry without verifying it: one truncated file ends every program that needs it. Here an entry is found by the
content of its source file and carries a checksum.
"""

from __future__ import annotations

import functools
import hashlib
import os
import sys
from pathlib import Path
from typing import Any

from numba import config
from numba.core import caching

ROOT = Path(__file__).resolve().parent.parent.parent
"""The folder of the packages; a file outside it, such as a user's model, is found by its path."""

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


class VerifiedCacheFile(caching.IndexDataCacheFile):  # type: ignore[misc]
    """Numba's index and data files, with a checksum before each."""

    def _read(self, path: str) -> bytes | None:
        """Content of a file, None if it is damaged, which is reported; such a file is deleted.

        Raises:
            FileNotFoundError: If there is none.
        """
        content = Path(path).read_bytes()
        if hashlib.sha256(content[DIGEST_SIZE:]).digest() == content[:DIGEST_SIZE]:
            return content[DIGEST_SIZE:]
        report_damage(config.CACHE_DIR)
        Path(path).unlink(missing_ok=True)
        return None

    def _write(self, path: str, content: bytes) -> None:
        with self._open_for_write(path) as file:
            file.write(hashlib.sha256(content).digest() + content)

    def _load_index(self) -> dict[Any, str]:
        try:
            content = self._read(self._index_path)
        except FileNotFoundError:
            return {}
        if content is None:
            return {}
        version, stamp, overloads = caching.pickle.loads(content)
        return overloads if (version, stamp) == (self._version, self._source_stamp) else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        self._write(self._index_path, self._dump((self._version, self._source_stamp, overloads)))

    def _load_data(self, name: str) -> Any:
        content = self._read(self._data_path(name))
        if content is None:
            raise FileNotFoundError(name)
        try:
            return caching.pickle.loads(content)
        except ModuleNotFoundError as error:
            # The same file was compiled under another module name, as `runpy` and `exec` do: compile it again.
            raise FileNotFoundError(name) from error

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._data_path(name), self._dump(data))


def use_entries() -> None:
    """Make Numba keep its cache in such entries, in this process."""
    caching.IndexDataCacheFile = VerifiedCacheFile
    # Numba's own locators serve functions that are in no file, as in a notebook.
    others = [found for found in caching.CompileResultCacheImpl._locator_classes if found is not ContentLocator]
    caching.CompileResultCacheImpl._locator_classes = [ContentLocator, *others]
