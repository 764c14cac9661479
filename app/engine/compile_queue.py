"""Queue of filters that processes of their own compile into the cache.

Numba compiles in one thread at a time and holds the interpreter, which would delay a measurement by half a minute.
Requested filters come first, on several processors; the others follow in the catalogue's order, at lowest priority.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait

from estimators.pieces import LOOP, Piece
from sources.pieces import KERNELS, is_made, make, needs, pieces_of

from .compilers import MAX_COMPILERS, Compiler
from .jobs import LOWEST_PRIORITY, LoopThread

POLL_PERIOD_S = 0.2
"""Seconds between two looks for new requests."""


class CompileQueue:
    """Queue of the filters of one twin and the decoders of its source, and the processes that compile them."""

    def __init__(
        self,
        names: Sequence[str] = (),
        *,
        pieces: Callable[[str], list[Piece]] = pieces_of,
        work: Callable[[Piece], None] = make,
        is_done: Callable[[Piece], bool] = is_made,
        workers: Sequence[Compiler] = (),
    ) -> None:
        """Look into the cache; nothing is compiled yet.

        Args:
            names: Filters and decoders of sources (`KERNELS`) that are compiled here; anything else counts as ready and
                is compiled where it is used.
            pieces: Returns the pieces of one of these, or of `LOOP`.
            work: Compiles a piece, in another process.
            is_done: Whether a piece is in the cache.
            workers: Processes that were started before.
        """
        self._work, self._workers = work, list(workers)
        self._left: dict[str, list[Piece]] = {}
        for name in dict.fromkeys(part for each in names for part in needs(each)):
            left = [piece for piece in pieces(name) if not is_done(piece)]
            if left:
                self._left[name] = left
        self._requested: dict[str, float] = {}
        self._waiting: list[tuple[str, Callable[[str], None]]] = []
        self._under_way: dict[Compiler, Piece] = {}
        self._lost: list[Piece] = []
        self.report: Callable[[str], None] = lambda text: None
        """Called with a line about a failure, in another thread."""
        self._wake = threading.Condition()
        self._thread = LoopThread(self._run, "compile queue")

    def start(self) -> None:
        """Begin; with nothing to compile there is no thread and no process."""
        if self._left:
            self._thread.start()
            return
        for worker in self._workers:
            worker.stop()

    def stop(self) -> None:
        """Stop compiling."""
        with self._wake:
            self._thread.stopping.set()
            self._wake.notify()
        self._thread.stop(2.0)

    def ready(self, name: str) -> bool:
        """Return whether a filter or decoder is in the cache."""
        return not any(part in self._left for part in needs(name))

    def request(self, name: str, done: Callable[[str], None] = lambda name: None) -> None:
        """Compile a filter or decoder before any other; `done` is called with its name, in another thread."""
        with self._wake:
            if not self.ready(name):
                self._requested.setdefault(name, time.monotonic())
            self._waiting.append((name, done))
            self._tell()
            self._wake.notify()

    def wait(self, name: str) -> None:
        """Wait until a filter or decoder is ready, or the queue ends."""
        ready = threading.Event()
        self.request(name, lambda name: ready.set())
        ready.wait()

    def states(self) -> dict[str, float | None]:
        """Return the filters that are not ready: seconds since each was begun, None for one that waits."""
        with self._wake:
            left = [name for name in self._left if name != LOOP and name not in KERNELS]
            now = time.monotonic()
            begun: dict[str, float | None] = {
                name: min((now - worker.begun for worker, piece in self._under_way.items() if piece.of == name),
                          default=None)
                for name in left
            }  # fmt: skip
            return begun | {name: now - since for name, since in self._requested.items() if name not in KERNELS}

    def _run(self) -> None:
        hurried = self._workers
        quiet: Compiler | None = None
        try:
            while True:
                with self._wake:
                    self._take_answers()
                    self._tell()
                    if self._thread.stopping.is_set() or not self._left:
                        return
                    hurried = [worker for worker in hurried if not worker.ended]
                    quiet = None if quiet is not None and quiet.ended else quiet
                    wanted = list(dict.fromkeys(part for name in self._requested for part in needs(name)))
                    while (piece := self._next(wanted)) is not None:
                        worker = next((each for each in hurried if each not in self._under_way), None)
                        if worker is None:
                            if len(hurried) == MAX_COMPILERS:
                                break
                            worker = Compiler(self._work, 0)
                            hurried.append(worker)
                        self._give(worker, piece)
                    if not wanted:
                        while hurried and all(worker not in self._under_way for worker in hurried):
                            hurried.pop().stop()
                        if quiet not in self._under_way and (piece := self._next_quiet()) is not None:
                            quiet = quiet or Compiler(self._work, LOWEST_PRIORITY)
                            self._give(quiet, piece)
                    if not self._under_way:
                        self._wake.wait()
                    answers = [worker.connection for worker in self._under_way]
                wait(answers, POLL_PERIOD_S)
        finally:
            workers = [*hurried, *([quiet] if quiet else [])]
            for worker in workers:
                worker.end()
            for worker in workers:
                worker.stop()
            with self._wake:
                self._left.clear()
                self._tell()

    def _give(self, worker: Compiler, piece: Piece) -> None:
        worker.give(piece)
        self._under_way[worker] = piece

    def _next(self, names: Sequence[str]) -> Piece | None:
        """Return a piece that can be begun now: decoders, which are needed first, then the slowest."""
        busy = self._under_way.values()
        left = [piece for name in names for piece in self._left.get(name, ()) if piece not in busy]
        able = [
            piece for piece in left if all(Piece(piece.of, place) not in self._left[piece.of] for place in piece.after)
        ]
        return min(able, key=lambda piece: (piece.of not in KERNELS, piece.place), default=None)

    def _next_quiet(self) -> Piece | None:
        return next((piece for name in self._left if (piece := self._next([name])) is not None), None)

    def _take_answers(self) -> None:
        """Take the finished pieces out.

        A piece that failed counts as done: its user compiles it and reports the error. So does one whose process was
        killed twice; the first time memory may have been short.
        """
        for worker in [each for each in self._under_way if each.answered()]:
            piece = self._under_way.pop(worker)
            if worker.ended:
                again = piece not in self._lost
                self._lost.append(piece)
                what = "a part of every filter or source" if piece.of == LOOP or piece.of in KERNELS else piece.of
                then = "it is compiled again" if again else "it is compiled where it is used, which delays the twin"
                self.report(f"the process that compiled {what} was killed, perhaps for lack of memory; {then}")
                if again:
                    continue
            left = self._left[piece.of]
            left.remove(piece)
            if not left:
                del self._left[piece.of]

    def _tell(self) -> None:
        for name, done in [item for item in self._waiting if self.ready(item[0])]:
            self._waiting.remove((name, done))
            self._requested.pop(name, None)
            done(name)
