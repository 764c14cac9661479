"""Read files of other programs in a process of their own.

A damaged file can make the library that reads it abort, run for ever, or take all memory. None of these may happen to
the twin.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from estimators.errors import NisusError, SourceError

from .worker_process import FAULT, ITEM, WorkerProcess, gist

ITEM_TIMEOUT_S = 30.0
"""Seconds that a reader may take for its next item, and one more for each `BYTES_A_SECOND` of the file."""

BYTES_A_SECOND = 2**20

MEMORY_BASE = 2**30
MEMORY_PER_BYTE = 16
"""Bytes of memory that a reader may take: the base, and so many for each byte of the file."""

MIN_WAIT_S = 0.005
"""Seconds of the shortest wait, so that a caller without a timeout does not spin."""

DRAIN_S = 0.1
"""Seconds within which a reader that was closed may come to its end and be used again."""

MAX_IDLE_WORKERS = 2
"""Idle readers that are kept; each has loaded its libraries, which takes longer than most files."""

EXIT_TIMEOUT_S = 5.0
"""Seconds between the end of a process's pipe and its own."""


class ReaderError(SourceError):
    """The reader of a file crashed, hung, took too much memory, or raised an error of its library."""


_idle: list[WorkerProcess] = []
_busy: set[WorkerProcess] = set()
"""Held here too: a source that is left open is collected with all it holds in any order, and then closes its reader."""

_lock = threading.RLock()  # A collection may close a reader wherever it happens, here as well.


def _forget() -> None:
    _idle.clear()
    _busy.clear()


# A process that forks keeps its readers; two that ask the same one would take each other's answers.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def _hire() -> WorkerProcess:
    with _lock:
        while _idle:
            worker = _idle.pop()
            if worker.alive:
                break
            worker.end()
        else:
            worker = WorkerProcess()
        _busy.add(worker)
        return worker


def _dismiss(worker: WorkerProcess) -> None:
    """Keep it for the next file, unless enough wait."""
    with _lock:
        _busy.discard(worker)
        if len(_idle) < MAX_IDLE_WORKERS:
            _idle.append(worker)
            return
    worker.end()


def _end(worker: WorkerProcess, grace: float = 0.0) -> str:
    with _lock:
        _busy.discard(worker)
    return worker.end(grace)


@atexit.register
def _end_idle() -> None:
    with _lock:
        for worker in (*_idle, *_busy):
            worker.end()
        _idle.clear()


class IsolatedReader:
    """The items of a generator that reads a file in a process of its own.

    Args:
        function: A generator function, importable by name, whose arguments and items can be pickled.
        path: The file; first argument of the function.
        args: Its further arguments.
        timeout: Seconds to wait for an item before the process is taken to hang; by default by the size of the file.
    """

    def __init__(
        self, function: Callable[..., Iterator[Any]], path: Path, *args: Any, timeout: float | None = None
    ) -> None:
        size = path.stat().st_size if path.is_file() else 0
        self._timeout = ITEM_TIMEOUT_S + size / BYTES_A_SECOND if timeout is None else timeout
        self._waited = 0.0
        self._worker: WorkerProcess | None = _hire()
        self._worker.ask(_read, function, path, args)

    @property
    def ended(self) -> bool:
        """Whether the last item has been taken."""
        return self._worker is None

    def take(self, timeout: float) -> Any:
        """Return the next item, or None: at the end (`ended`), or if none came within `timeout` seconds.

        Raises:
            ReaderError: If the process ended, hung, or the generator raised.
            NisusError: As the generator raised it.
        """
        worker = self._worker
        if worker is None:
            return None
        timeout = max(timeout, MIN_WAIT_S)
        begun = time.monotonic()
        try:
            answer = worker.answer(timeout)
        except EOFError:
            self._worker = None
            raise ReaderError(f"its reader {_end(worker, EXIT_TIMEOUT_S)}") from None
        if answer is None:
            # No more than was meant to be waited: a machine that was suspended meanwhile has not hung.
            self._waited += min(time.monotonic() - begun, timeout)
            if self._waited >= self._timeout:
                self._worker = None
                _end(worker)
                raise ReaderError(f"its reader gave nothing for {self._timeout:.0f} s and was ended")
            return None
        self._waited = 0.0
        kind, item = answer
        if kind == ITEM:
            return item
        self._worker = None
        _dismiss(worker)
        if kind == FAULT:
            raise item
        return None

    def close(self) -> None:
        """Let go of the process: it comes to its end very soon, or is ended."""
        worker, self._worker = self._worker, None
        if worker is None:
            return
        limit = time.monotonic() + DRAIN_S
        with suppress(EOFError):
            while (left := limit - time.monotonic()) > 0:
                answer = worker.answer(left)
                if answer is not None and answer[0] != ITEM:
                    _dismiss(worker)
                    return
        _end(worker)


def memory_limit(path: Path) -> int:
    """Bytes of memory that the reader of a file may take."""
    return MEMORY_BASE + MEMORY_PER_BYTE * (path.stat().st_size if path.is_file() else 0)


def memory_error(path: Path | str, needed: str, limit: int) -> ReaderError:
    """Return the error of a file whose content does not fit; `needed` is a clause, as "its arrays take 3.0 GiB"."""
    return ReaderError(
        f"{path}: {needed}, and a file of this size may take {limit / 2**30:.1f} GiB; save it uncompressed, or in "
        "smaller files"
    )


def read_isolated(
    function: Callable[..., Iterator[Any]], path: Path, *args: Any, timeout: float | None = None
) -> list[Any]:
    """Return all items of an `IsolatedReader`.

    Raises:
        ReaderError: See `IsolatedReader.take`.
    """
    reader = IsolatedReader(function, path, *args, timeout=timeout)
    items = []
    try:
        while not reader.ended:
            if (item := reader.take(1.0)) is not None:
                items.append(item)
    finally:
        reader.close()
    return items


def _read(function: Callable[..., Iterator[Any]], path: Path, args: tuple[Any, ...]) -> Iterator[Any]:
    """In the worker: read a file with limited memory."""
    limit = memory_limit(path)
    _limit_memory(limit)
    try:
        yield from function(path, *args)
    except (NisusError, GeneratorExit):
        raise
    except MemoryError:
        _limit_memory(None)
        raise memory_error(path, "its content takes more", limit) from None
    except BaseException as error:  # libraries raise anything, some of it no Exception
        raise ReaderError(gist(error)) from None


def _limit_memory(allowance: int | None) -> None:
    """Let this process allocate at most `allowance` bytes more than it holds now; None lifts the limit."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        if allowance is None:
            limit = hard
        else:
            status = Path("/proc/self/status").read_text()
            held = 1024 * int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmData")))
            limit = held + min(allowance, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 4 * 3)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
