"""Worker processes: run generator functions in a Python process of its own that ends with this one.

A worker crashes, hangs or runs out of memory without harm to this process. File readers (`reader_process`) and the
workshop's compilers use it. Nothing that takes long is imported here, so that a worker begins first.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from estimators.errors import NisusError

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
        # The pipe is never written to: its end tells the worker, wherever it is, that this process has gone.
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

    def _write(self, *items: Any) -> None:
        with suppress(BrokenPipeError):  # A worker that died says so where its answer is awaited.
            for item in items:
                pickle.dump(item, self._requests)
            self._requests.flush()

    def ask(self, function: Callable[..., Iterator[Any]], *args: Any) -> None:
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

    @property
    def alive(self) -> bool:
        """Whether the process is still there."""
        return self._process.poll() is None

    def kill(self) -> None:
        """Have the process end at once, without waiting."""
        self._process.kill()

    def end(self, grace: float = 0.0) -> str:
        """End it, and say how it had ended if it had: its status comes up to `grace` seconds after its pipe closed."""
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


def gist(error: BaseException) -> str:
    """Return an error's message in one short line."""
    return " ".join(str(error).split())[:160] or type(error).__name__


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
