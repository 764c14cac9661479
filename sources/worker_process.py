"""Worker processes: run generator functions in a Python process of its own that ends with this one.

A worker crashes, hangs or runs out of memory without harm to this process. Compilers of filters and the readers of
foreign files (`IsolatedReader`) use it. Nothing that takes long is imported here, so that a worker begins first.
"""

from __future__ import annotations

import atexit
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Generic, TypeVar

from estimators.errors import NisusError, SourceError

T = TypeVar("T")
ITEM, END, FAULT = range(3)
"""Kinds of answer: an item of the generator, its end, the error that it raised."""

_BOOT = f"""
import pickle, sys
lifeline, sys.path[:] = pickle.load(sys.stdin.buffer)
from {__name__} import serve
serve(lifeline)
"""


class WorkerProcess:
    """A process that runs one generator after another and returns their items over a pipe, which bounds its lead."""

    def __init__(self) -> None:
        # The pipe is never written to: its end signals the worker that this process has ended.
        theirs, self._lifeline = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _BOOT],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            pass_fds=[theirs],
        )
        os.close(theirs)
        assert self._process.stdin is not None and self._process.stdout is not None
        self._requests = self._process.stdin
        self.answers = Connection(os.dup(self._process.stdout.fileno()), writable=False)
        """For `multiprocessing.connection.wait`: ready when there is an answer, or the process has ended."""
        self._process.stdout.close()
        self.pid = self._process.pid
        self._write((theirs, list(sys.path)))

    def _write(self, *items: object) -> None:
        with suppress(BrokenPipeError):  # The end of a worker is reported where its answer is awaited.
            for item in items:
                pickle.dump(item, self._requests)
            self._requests.flush()

    def submit(self, function: Callable[..., Iterator[object]], *args: object) -> None:
        """Run `function(*args)` after what was asked before; it must be importable by name."""
        # The folder comes first and by itself: a function may be from a folder that was added since.
        self._write((list(sys.path), os.getcwd()), (function, args))

    def answer(self, timeout: float) -> tuple[int, Any] | None:
        """Return the next answer (kind, item); None if none comes in time.

        Raises:
            EOFError: If the process has ended.
        """
        try:
            return pickle.loads(self.answers.recv_bytes()) if self.answers.poll(timeout) else None
        except OSError as error:
            raise EOFError from error

    def waits(self) -> bool:
        """Return whether it waits for work; one that was ended is still there while its memory is given back."""
        self.submit(iter, ())
        with suppress(EOFError):
            return self.answer(EXIT_TIMEOUT_S) is not None
        return False

    def processor_time(self) -> float | None:
        """Return the processor time, s, of a process that computes or waits for a processor; None if it sleeps."""
        try:
            state, *fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
            return (int(fields[10]) + int(fields[11])) / os.sysconf("SC_CLK_TCK") if state == "R" else None
        except (OSError, ValueError, IndexError):
            return None  # No Linux: what it waits for is not known.

    def kill(self) -> None:
        """Have the process end at once, without waiting."""
        self._process.kill()

    def end(self, grace: float = 0.0) -> str:
        """End it; return how it ended: its status comes up to `grace` seconds after its pipe closed."""
        self.answers.close()
        with suppress(BrokenPipeError):
            self._requests.close()
        os.close(self._lifeline)
        try:
            code = self._process.wait(grace)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return "was ended"
        if code >= 0:
            return f"ended with status {code}"
        try:
            return f"was ended by {signal.Signals(-code).name}"
        except ValueError:
            return f"was ended by signal {-code}"


def serve(lifeline: int) -> None:
    """Run requests in the worker until the process that sends them has gone."""
    _end_with_parent(lifeline)
    answers = Connection(os.dup(1), readable=False)
    os.dup2(2, 1)  # What libraries print is no answer.
    requests = sys.stdin.buffer
    with suppress(EOFError, BrokenPipeError, KeyboardInterrupt):
        while True:
            sys.path[:], folder = pickle.load(requests)
            os.chdir(folder)
            function, args = pickle.load(requests)
            try:
                for item in function(*args):
                    answers.send((ITEM, item))
                answers.send((END, None))
            except (BrokenPipeError, KeyboardInterrupt):
                raise
            except NisusError as error:
                answers.send((FAULT, error))
            except BaseException as error:  # noqa: BLE001  libraries raise anything, some of it no Exception
                answers.send((FAULT, NisusError(gist(error))))


def gist(error: object) -> str:
    """Return the message of an error, or its type if it has none, in one short line."""
    return " ".join(str(getattr(error, "strerror", None) or error).split())[:160] or type(error).__name__


def _end_with_parent(lifeline: int) -> None:
    """Have the kernel end this process with its parent: a library that hangs would let no thread of Python see it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this process in its time.
    with suppress(ImportError, OSError):
        import fcntl

        signal.signal(signal.SIGIO, signal.SIG_DFL)
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)
        # The last end may have closed before the signal was asked for.
        import select

        if select.select([lifeline], [], [], 0)[0]:
            os._exit(1)
    with suppress(OSError):
        # If memory runs out all the same, this process ends first, not the twin.
        Path("/proc/self/oom_score_adj").write_text("1000")


ITEM_TIMEOUT_S = 30.0
"""Seconds that a reader may take for its next item, and one more for each `BYTES_A_SECOND` of the file.

While it waits for a processor, which others use, the time does not count.
"""

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

EXIT_TIMEOUT_S = 5.0  # Seconds between the end of a process's pipe and its own, and to answer while idle


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
            if worker.waits():
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


class IsolatedReader(Generic[T]):
    """The items of a generator that reads a file in a process of its own.

    Args:
        function: A generator function, importable by name, whose arguments and items can be pickled.
        path: The file; first argument of the function.
        args: Its further arguments.
        timeout: Seconds to wait for an item before the process is taken to hang; by default by the size of the file.
        keep: Whether the process is kept for the next file; else it ends, and with it the memory that it took.
    """

    def __init__(
        self,
        function: Callable[..., Iterator[T]],
        path: Path,
        *args: object,
        timeout: float | None = None,
        keep: bool = True,
    ) -> None:
        self._keep = keep
        size = path.stat().st_size if path.is_file() else 0
        self._timeout = ITEM_TIMEOUT_S + size / BYTES_A_SECOND if timeout is None else timeout
        self._waited = 0.0
        self._computed: float | None = None
        self._worker: WorkerProcess | None = _hire()
        self._worker.submit(_read, function, path, args)

    @property
    def ended(self) -> bool:
        """Whether the last item has been taken."""
        return self._worker is None

    def get(self, timeout: float) -> T | None:
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
            # At most the timeout: a machine that was suspended meanwhile has not hung.
            waited = min(time.monotonic() - begun, timeout)
            before, self._computed = self._computed, worker.processor_time()
            if before is not None and self._computed is not None:
                waited = min(self._computed - before, waited)
            self._waited += waited
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
        if self._keep:
            _dismiss(worker)
        else:
            _end(worker)
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
    function: Callable[..., Iterator[T]], path: Path, *args: object, timeout: float | None = None
) -> list[T]:
    """Return all items of an `IsolatedReader`.

    Raises:
        ReaderError: See `IsolatedReader.get`.
    """
    reader = IsolatedReader(function, path, *args, timeout=timeout)
    items = []
    try:
        while not reader.ended:
            if (item := reader.get(1.0)) is not None:
                items.append(item)
    finally:
        reader.close()
    return items


def _read(function: Callable[..., Iterator[T]], path: Path, args: tuple[object, ...]) -> Iterator[T]:
    """In the worker: read a file with limited memory."""
    limit = memory_limit(path)
    os.environ["ARROW_DEFAULT_MEMORY_POOL"] = "system"  # mimalloc would map 1 GiB at its first allocation
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
