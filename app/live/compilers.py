"""The processes in which filters are compiled; nothing that takes long is imported here, so that they begin first."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from estimators.compiled.orphan import leave_with_parent
from estimators.numerics.cache import cache_folder

if TYPE_CHECKING:
    from estimators.pieces import Piece

MOST = min(3, max(2, os.cpu_count() or 1))
"""Processes at most that compile what is asked for; more have no more pieces to take."""


def first_workers() -> list[Worker]:
    """Workers that get ready while the program imports its own parts, where nothing was ever compiled; else none."""
    if "NUMBA_CACHE_DIR" in os.environ or cache_folder().exists():
        return []
    return [Worker(None, 0) for _ in range(MOST)]


class Worker:
    """A process that compiles one piece after another."""

    def __init__(self, work: Callable[[Piece], None] | None, niceness: int) -> None:
        """Start it; `work` None is that of `sources/pieces.py`, imported there alone."""
        context = multiprocessing.get_context("spawn")
        self.connection, its_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(its_end, work, niceness), name="compile", daemon=True)
        self._process.start()
        its_end.close()
        self.begun = 0.0
        self.ended = False
        """Whether the process was found to have ended."""

    def give(self, piece: Piece) -> None:
        """Begin a piece."""
        self.begun = time.monotonic()
        with contextlib.suppress(OSError):  # a process that has ended answers so, below
            self.connection.send(piece)

    def answered(self) -> bool:
        """Whether the piece is done, or the process has ended."""
        try:
            return self.connection.poll() and (self.connection.recv(), True)[1]
        except (EOFError, OSError):
            self.ended = True
            self.stop()
            return True

    def end(self) -> None:
        """Have the process end; what it writes into the cache is there whole or not at all."""
        self._process.kill()

    def stop(self) -> None:
        """End the process, and wait until it has."""
        self.end()
        self._process.join(1.0)
        self.connection.close()


def _serve(connection: Connection[Any, Piece], work: Callable[[Piece], None] | None, niceness: int) -> None:
    """In a process of its own: do what is sent, and answer."""
    leave_with_parent()
    # Ctrl-C is for the process that shows the twin, which ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if niceness and sys.platform != "win32":
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
    from sources.pieces import make

    work = work or make
    # Compiling leaves few cycles behind, and looking for them takes an eighth of the time.
    gc.disable()
    while True:
        try:
            piece = connection.recv()
        except EOFError:
            return
        with contextlib.suppress(Exception):
            work(piece)
        connection.send(None)
