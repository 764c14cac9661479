"""Worker processes that compile filters; nothing that takes long is imported here, so that they begin first."""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

from estimators.numerics.cache import cache_folder
from sources.worker_process import ITEM, WorkerProcess

if TYPE_CHECKING:
    from estimators.pieces import Piece

MAX_COMPILERS = min(3, max(2, os.cpu_count() or 1))
"""Processes at most that compile what is asked for; more find no more pieces to compile at once."""

COMPILE_TIMEOUT_S = 600.0
"""Seconds after which a compiler counts as hung."""


def first_compilers() -> list[Compiler]:
    """Return compilers that start while the program imports its own parts, if nothing was ever compiled; else none."""
    if "NUMBA_CACHE_DIR" in os.environ or cache_folder().exists():
        return []
    return [Compiler(None, 0) for _ in range(MAX_COMPILERS)]


class Compiler:
    """A process that compiles one piece after another."""

    def __init__(self, work: Callable[[Piece], None] | None, niceness: int) -> None:
        """Start it; `work` None is `make` of `sources/pieces.py`, imported there alone."""
        self._process = WorkerProcess()
        self._process.submit(_set_up, niceness)
        self._work, self._left = work, 1
        self.connection = self._process.answers
        self.begun = 0.0
        self.ended = False
        """Whether the process was found to have ended."""

    def give(self, piece: Piece) -> None:
        """Begin a piece."""
        self.begun = time.monotonic()
        self._left += 1
        self._process.submit(_compile, self._work, piece)

    def answered(self) -> bool:
        """Return whether the piece is done, or the process has ended, if necessary after a timeout."""
        if time.monotonic() - self.begun > COMPILE_TIMEOUT_S:
            self.end()
        try:
            while self._left and (answer := self._process.answer(0.0)) is not None:
                self._left -= answer[0] != ITEM
        except EOFError:
            self.stop()
            self.ended = True
        return not self._left or self.ended

    def end(self) -> None:
        """Have the process end; a cache entry is written completely or not at all."""
        self._process.kill()

    def stop(self) -> None:
        """End the process, and wait until it has."""
        if not self.ended:
            self._process.end()


def _set_up(niceness: int) -> Iterator[None]:
    """In the process: take its priority, and import what compiles."""
    if niceness and sys.platform != "win32":
        os.setpriority(os.PRIO_PROCESS, 0, niceness)

    # Compiling leaves few cycles behind, and looking for them takes an eighth of the time.
    gc.disable()
    yield from ()


def _compile(work: Callable[[Piece], None] | None, piece: Piece) -> Iterator[None]:
    """In the process: compile a piece."""
    from sources.pieces import make

    with suppress(Exception):
        (work or make)(piece)
    yield from ()
