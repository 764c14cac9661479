"""The workshop: processes of their own compile filters into the cache, so that nobody waits for one that is not chosen.

Numba compiles in one thread at a time, and holds the interpreter while it does; beside the engine it would slow every
reading for half a minute. What is asked for comes first, on several processors; all other filters that apply follow one
after another, at the lowest priority, in the order of the catalogue.
"""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from estimators.compiled.orphan import leave_with_parent
from estimators.pieces import LOOP, Piece, is_made, make, pieces_of

from .integrity import LOWEST

HURRY = 3
"""Processes at most that compile what is asked for; more have no more pieces to take."""

LOOK = 0.2
"""Seconds between two looks at whether something else was asked for."""


class Workshop:
    """Compiles the filters of one twin."""

    def __init__(
        self,
        names: Sequence[str] = (),
        *,
        pieces: Callable[[str], list[Piece]] = pieces_of,
        work: Callable[[Piece], None] = make,
        is_done: Callable[[Piece], bool] = is_made,
    ) -> None:
        """Look at what is in the cache; nothing is compiled yet.

        Args:
            names: Filters that are compiled here; any other is compiled where it is used, and counts as ready.
            pieces: Of a filter or of `LOOP`.
            work: Compiles a piece, in another process.
            is_done: Whether a piece needs no work.
        """
        self._work = work
        self._left: dict[str, list[Piece]] = {}
        for name in (LOOP, *names) if names else ():
            left = [piece for piece in pieces(name) if not is_done(piece)]
            if left:
                self._left[name] = left
        self._asked: dict[str, float] = {}
        self._told: list[tuple[str, Callable[[str], None]]] = []
        self._under_way: dict[Worker, Piece] = {}
        self._wake = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="workshop", daemon=True)

    def start(self) -> None:
        """Begin; with nothing left to do there is no thread, and no process."""
        if self._left:
            self._thread.start()

    def stop(self) -> None:
        """Give up what is under way."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)

    def ready(self, name: str) -> bool:
        """Whether a filter can be had from the cache."""
        return LOOP not in self._left and name not in self._left

    def ask(self, name: str, done: Callable[[str], None] = lambda name: None) -> None:
        """Compile a filter at once, before any other; `done` is told its name when it is ready, in another thread."""
        with self._wake:
            if not self.ready(name):
                self._asked.setdefault(name, time.monotonic())
            self._told.append((name, done))
            self._tell()
            self._wake.notify()

    def states(self) -> dict[str, float | None]:
        """Filters that are not ready: for how many seconds each has been compiled, None of one that waits."""
        with self._wake:
            left = dict.fromkeys(self._left)
            now = time.monotonic()
            begun: dict[str, float | None] = {
                name: min((now - worker.begun for worker, piece in self._under_way.items() if piece.of == name),
                          default=None)
                for name in left
            }  # fmt: skip
            for name, since in self._asked.items():
                begun[name] = now - since
            begun.pop(LOOP, None)
            return begun

    def _run(self) -> None:
        hurried: list[Worker] = []
        quiet: Worker | None = None
        try:
            while True:
                with self._wake:
                    self._take_answers()
                    self._tell()
                    if self._stopping or not self._left:
                        return
                    wanted = [LOOP, *self._asked] if self._asked else []
                    while (piece := self._next(wanted)) is not None:
                        worker = next((each for each in hurried if each not in self._under_way), None)
                        if worker is None:
                            if len(hurried) == min(HURRY, max(2, os.cpu_count() or 1)):
                                break
                            worker = Worker(self._work, 0)
                            hurried.append(worker)
                        self._give(worker, piece)
                    if not wanted:
                        while hurried and all(worker not in self._under_way for worker in hurried):
                            hurried.pop().stop()
                        if quiet not in self._under_way and (piece := self._next_quiet()) is not None:
                            quiet = quiet or Worker(self._work, LOWEST)
                            self._give(quiet, piece)
                    if not self._under_way:
                        self._wake.wait()
                    answers = [worker.connection for worker in self._under_way]
                wait(answers, LOOK)
        finally:
            for worker in (*hurried, *([quiet] if quiet else [])):
                worker.stop()
            with self._wake:
                self._left.clear()
                self._tell()

    def _give(self, worker: Worker, piece: Piece) -> None:
        worker.give(piece)
        self._under_way[worker] = piece

    def _next(self, names: Sequence[str]) -> Piece | None:
        """A piece that can be begun now; what takes longest comes first."""
        busy = self._under_way.values()
        left = [piece for name in names for piece in self._left.get(name, ()) if piece not in busy]
        able = [
            piece for piece in left if all(Piece(piece.of, place) not in self._left[piece.of] for place in piece.after)
        ]
        return min(able, key=lambda piece: piece.place, default=None)

    def _next_quiet(self) -> Piece | None:
        return next((piece for name in self._left if (piece := self._next([name])) is not None), None)

    def _take_answers(self) -> None:
        """A piece that failed counts as done: who uses it compiles it, and says what is wrong."""
        for worker in [each for each in self._under_way if each.answered()]:
            piece = self._under_way.pop(worker)
            left = self._left[piece.of]
            left.remove(piece)
            if not left:
                del self._left[piece.of]

    def _tell(self) -> None:
        for name, done in [item for item in self._told if self.ready(item[0])]:
            self._told.remove((name, done))
            self._asked.pop(name, None)
            done(name)


class Worker:
    """A process that compiles one piece after another."""

    def __init__(self, work: Callable[[Piece], None], niceness: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, its_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(its_end, work, niceness), name="compile", daemon=True)
        self._process.start()
        its_end.close()
        self.begun = 0.0

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
            return True

    def stop(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join(1.0)
        self.connection.close()


def _serve(connection: Connection[Any, Piece], work: Callable[[Piece], None], niceness: int) -> None:
    """In a process of its own: do what is sent, and answer."""
    leave_with_parent()
    # Ctrl-C is for the process that shows the twin, which ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if niceness and sys.platform != "win32":
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
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
