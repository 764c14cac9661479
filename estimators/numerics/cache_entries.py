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
from types import FunctionType
from typing import Any

import numba
from llvmlite import binding
from numba import config
from numba.core import base, bytecode, caching, codegen, compiler, dispatcher
from numba.core.runtime import _nrt_python
from numba.core.typing import templates

ROOT = Path(__file__).resolve().parent.parent.parent
"""The folder of the packages; a file outside it, such as a user's model, is found by its path."""

ENTRY_FORMAT = 4
"""To be increased when entries that an earlier version wrote are not to be read."""

DIGEST_SIZE = hashlib.sha256().digest_size


@functools.cache
def report_damage(folder: str) -> None:
    """Print one line per process about damaged entries."""
    print(f"nisus: {folder}: damaged entries of the compile cache discarded; compiling them again", file=sys.stderr)


class ContentLocator(caching._SourceFileBackedLocatorMixin, caching._CacheLocator):  # type: ignore[misc]
    """Locates the cache of a function by the content of its source file, and by `nisus.` in an installation."""

    def __init__(self, function: FunctionType, file: str) -> None:
        path = Path(file).resolve()
        inside = path.is_relative_to(ROOT)
        folder = str(path.parent.relative_to(ROOT)) if inside else self.get_suitable_cache_subpath(file)
        self._path = os.path.join(config.CACHE_DIR, __name__.partition("estimators")[0] + folder.replace(os.sep, "."))
        self._stamp = hashlib.sha256(path.read_bytes()).hexdigest()
        self._lineno = function.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        """Folder of the entries."""
        return self._path

    def get_source_stamp(self) -> str:
        """Digest of the source file; an entry with another one is stale."""
        return self._stamp


class EntryFiles(caching.IndexDataCacheFile):  # type: ignore[misc]
    """One file per entry, named by a digest of its key: digests of its purpose and of the rest, then the rest.

    Numba numbers the files and keeps the numbers in an index. Of two processes that saved the code of two closures at
    once, one lost its entry, or was given the machine code of the other.
    """

    def __init__(self, cache_path: str, filename_base: str, source_stamp: str) -> None:
        self._path_of = os.path.join(cache_path, f"{filename_base}.{{}}.nbc").format
        self._valid = ENTRY_FORMAT, numba.__version__, source_stamp

    def _path(self, key: object) -> Path:
        return Path(self._path_of(hashlib.sha256(repr(key).encode()).hexdigest()[:16]))

    def _purpose(self, key: object) -> bytes:
        return hashlib.sha256(repr((self._valid, key)).encode()).digest()

    def __contains__(self, key: object) -> bool:
        """Return whether there is an entry of the present source, which takes a tenth of a millisecond."""
        try:
            with self._path(key).open("rb") as file:
                return file.read(DIGEST_SIZE) == self._purpose(key)
        except OSError:
            return False

    def save(self, key: object, data: object) -> None:
        """Save compiled code; of two processes that compiled the same, the last."""
        content = self._dump((key, data))
        with self._open_for_write(str(self._path(key))) as file:
            file.write(self._purpose(key) + hashlib.sha256(content).digest() + content)

    def load(self, key: object) -> object:
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


class EntryLibrary(codegen.JITCodeLibrary):  # type: ignore[misc]
    """Machine code, whose bitcode is parsed when other code links it: half of the time of loading an entry.

    Numba takes from the bitcode also which functions there are. Here `EntryResults` knows.
    """

    _bitcode: bytes | None = None

    @classmethod
    def _unserialize(cls, codegen: codegen.JITCPUCodegen, state: tuple) -> EntryLibrary:
        name, _, (code, bitcode) = state
        library = codegen.create_library(name) if code else LinkedLibrary(codegen, name)
        library._bitcode = bitcode
        if not code:
            library._finalized = True
            return library
        library.enable_object_caching()
        library._set_compiled_object(code)
        library._finalize_final_module()
        return library

    def _get_module_for_linking(self) -> binding.ModuleRef:
        if self._bitcode is not None:
            self._shared_module, self._bitcode = binding.parse_bitcode(self._bitcode), None
            self._codegen._engine._load_defined_symbols(self._shared_module)
        return super()._get_module_for_linking()


class LinkedLibrary(EntryLibrary):
    """Bitcode of a function that only compiled functions call: they link it, optimise it and make machine code of it.

    Numba does both for each function by itself, too, which takes a quarter of the compile time of a filter.
    """

    @property
    def codegen(self) -> LinkedLibrary:
        """Receiver of the environment of the function, which exceptions alone need."""
        return self

    def set_env(self, name: str, environment: object) -> None:
        """Do nothing, see `codegen`."""

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0: there is no such machine code."""
        self._ensure_finalized()
        return 0

    def _optimize_final_module(self) -> None:
        """Leave that to what links it."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes, bytes]]:
        """Return what `EntryLibrary` reads."""
        return self.name, "object", (b"", self._get_module_for_linking().as_bitcode())

    def _get_module_for_linking(self) -> binding.ModuleRef:
        if self._bitcode is not None:
            self._shared_module, self._bitcode = binding.parse_bitcode(self._bitcode), None
        return super()._get_module_for_linking()


class Linked(compiler.Compiler):  # type: ignore[misc]
    """Compiles a function that only compiled functions call."""

    def compile_extra(self, func: FunctionType) -> compiler.CompileResult:
        """Compile into a `LinkedLibrary`, without wrappers for Python and C."""
        self.state.flags.no_cpython_wrapper = self.state.flags.no_cfunc_wrapper = True
        self.state.library = LinkedLibrary(self.state.targetctx.codegen(), func.__qualname__)
        return super().compile_extra(func)


class EntryResults(caching.CompileResultCacheImpl):  # type: ignore[misc]
    """Compiled functions from entries."""

    def rebuild(self, target_context: base.BaseContext, payload: tuple) -> compiler.CompileResult:
        """Return a compiled function; some have no wrapper for Python."""
        (_, _, (code, _)), described, *_ = payload
        if not code:
            return super().rebuild(target_context, payload)
        defined = target_context.codegen()._engine._defined_symbols
        defined.add(described.llvm_func_name)
        if f"{described.llvm_cpython_wrapper_name}\0".encode() in code:
            defined.add(described.llvm_cpython_wrapper_name)
        return super().rebuild(target_context, payload)


@functools.cache
def _declare_runtime() -> None:
    """Tell LLVM where Numba's runtime is. `rtsys.initialize` also compiles functions, for which LLVM takes 18 MB."""
    from numba.cpython import hashing  # noqa: F401  tells the address of the hash secret

    for name, address in _nrt_python.c_helpers.items():
        binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


class FunctionEntries(caching.FunctionCache):  # type: ignore[misc]
    """Entries of one function, set up when it is first compiled: a start needs two dozen of hundreds of functions.

    Code from the cache needs addresses of Numba's runtime and of its hash secret, but not its tables of types and
    functions, which take 0.3 s and 40 MB: compiling fills them itself.
    """

    _impl_class = EntryResults

    linked = False
    """Whether the entries are bitcode alone, see `Linked`."""

    def __init__(self, function: FunctionType) -> None:
        self._py_func = function

    def _index_key(self, sig: object, codegen: object) -> tuple[object, ...]:
        """Return the key of an entry, which of one function differs for the two kinds."""
        return (*super()._index_key(sig, codegen), self.linked)

    def __getattr__(self, name: str) -> Any:
        if "_impl" in vars(self):
            raise AttributeError(name)
        super().__init__(self._py_func)
        return getattr(self, name)

    def load_overload(self, sig: object, target_context: base.BaseContext) -> compiler.CompileResult | None:
        """Return a compiled function, None if it is not in the cache."""
        _declare_runtime()
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


def use_entries() -> None:
    """Make Numba keep its cache in such entries, in this process.

    Numba tells functions of one name apart by a number that it counts from 1 in every process. So the entries of two
    closures that two processes compiled contain different functions under one symbol, and a process that loads both
    uses the first for both. Counting from a random number makes the symbols different.
    """
    bytecode.FunctionIdentity._unique_ids = itertools.count(int.from_bytes(os.urandom(6), "big"))
    caching.IndexDataCacheFile = EntryFiles
    dispatcher.FunctionCache = FunctionEntries  # type: ignore[attr-defined]
    codegen.JITCPUCodegen._library_class = EntryLibrary
    # Numba's own functions, such as `np.empty`, are called by compiled code alone.
    decorator = templates._OverloadFunctionTemplate._get_jit_decorator
    templates._OverloadFunctionTemplate._get_jit_decorator = lambda template: functools.partial(
        decorator(template), pipeline_class=Linked
    )
    # Numba's own locators serve functions that are in no file, as in a notebook.
    others = [found for found in caching.CompileResultCacheImpl._locator_classes if found is not ContentLocator]
    caching.CompileResultCacheImpl._locator_classes = [ContentLocator, *others]
