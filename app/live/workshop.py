"""The workshop: processes of their own compile filters into the cache, so that nobody waits for one that is not chosen.

Numba compiles in one thread at a time, and holds the interpreter while it does; beside the engine it would slow every
reading for half a minute. What is asked for comes first, on several processors; all other filters that apply follow one
after another, at the lowest priority, in the order of the catalogue.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait

from estimators.pieces import LOOP, Piece
from sources.pieces import KERNELS, is_made, make, needs, pieces_of

from .compilers import MAX_COMPILERS, Compiler
from .jobs import LOWEST_PRIORITY

LOOK = 0.2
"""Seconds between two looks at whether something else was asked for."""


class Workshop:
    """Compiles the filters of one twin, and what its source needs."""

    def __init__(
        self,
        names: Sequence[str] = (),
        *,
        pieces: Callable[[str], list[Piece]] = pieces_of,
        work: Callable[[Piece], None] = make,
        is_done: Callable[[Piece], bool] = is_made,
        workers: Sequence[Compiler] = (),
    ) -> None:
        """Look at what is in the cache; nothing is compiled yet.

        Args:
            names: Filters that are compiled here, and what a source needs (`KERNELS`); anything else is compiled where
                it is used, and counts as ready.
            pieces: Of one of these, or of `LOOP`.
            work: Compiles a piece, in another process.
            is_done: Whether a piece needs no work.
            workers: Processes that were started before.
        """
        self._work, self._workers = work, list(workers)
        self._left: dict[str, list[Piece]] = {}
        for name in dict.fromkeys(part for each in names for part in needs(each)):
            left = [piece for piece in pieces(name) if not is_done(piece)]
            if left:
                self._left[name] = left
        self._asked: dict[str, float] = {}
        self._told: list[tuple[str, Callable[[str], None]]] = []
        self._under_way: dict[Compiler, Piece] = {}
        self._lost: list[Piece] = []
        self.report: Callable[[str], None] = lambda text: None
        """Told of what went wrong, in another thread."""
        self._wake = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="workshop", daemon=True)

    def start(self) -> None:
        """Begin; with nothing left to do there is no thread, and no process."""
        if self._left:
            self._thread.start()
            return
        for worker in self._workers:
            worker.stop()

    def stop(self) -> None:
        """Give up what is under way."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)

    def ready(self, name: str) -> bool:
        """Whether a filter, or what a source needs, can be had from the cache."""
        return not any(part in self._left for part in needs(name))

    def ask(self, name: str, done: Callable[[str], None] = lambda name: None) -> None:
        """Compile something at once, before any other; `done` is told its name when it is ready, in another thread."""
        with self._wake:
            if not self.ready(name):
                self._asked.setdefault(name, time.monotonic())
            self._told.append((name, done))
            self._tell()
            self._wake.notify()

    def wait(self, name: str) -> None:
        """Until something is ready, or the workshop ends."""
        ready = threading.Event()
        self.ask(name, lambda name: ready.set())
        ready.wait()

    def states(self) -> dict[str, float | None]:
        """Filters that are not ready: for how many seconds each has been compiled, None of one that waits."""
        with self._wake:
            left = [name for name in self._left if name != LOOP and name not in KERNELS]
            now = time.monotonic()
            begun: dict[str, float | None] = {
                name: min((now - worker.begun for worker, piece in self._under_way.items() if piece.of == name),
                          default=None)
                for name in left
            }  # fmt: skip
            return begun | {name: now - since for name, since in self._asked.items() if name not in KERNELS}

    def _run(self) -> None:
        hurried = self._workers
        quiet: Compiler | None = None
        try:
            while True:
                with self._wake:
                    self._take_answers()
                    self._tell()
                    if self._stopping or not self._left:
                        return
                    hurried = [worker for worker in hurried if not worker.ended]
                    quiet = None if quiet is not None and quiet.ended else quiet
                    wanted = list(dict.fromkeys(part for name in self._asked for part in needs(name)))
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
                wait(answers, LOOK)
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
        """A piece that can be begun now: what a source needs, which is waited for first, then what takes longest."""
        busy = self._under_way.values()
        left = [piece for name in names for piece in self._left.get(name, ()) if piece not in busy]
        able = [
            piece for piece in left if all(Piece(piece.of, place) not in self._left[piece.of] for place in piece.after)
        ]
        return min(able, key=lambda piece: (piece.of not in KERNELS, piece.place), default=None)

    def _next_quiet(self) -> Piece | None:
        return next((piece for name in self._left if (piece := self._next([name])) is not None), None)

    def _take_answers(self) -> None:
        """A piece that failed counts as done: who uses it compiles it, and says what is wrong.

        So does one with which two processes were ended from outside; with the first it was perhaps the memory that was
        short.
        """
        for worker in [each for each in self._under_way if each.answered()]:
            piece = self._under_way.pop(worker)
            if worker.ended:
                again = piece not in self._lost
                self._lost.append(piece)
                what = "what a source or any filter needs" if piece.of == LOOP or piece.of in KERNELS else piece.of
                then = "another one begins anew" if again else "it is compiled where it is used, slowing all else"
                self.report(f"a process that compiled {what} was ended, as where memory is short; {then}")
                if again:
                    continue
            left = self._left[piece.of]
            left.remove(piece)
            if not left:
                del self._left[piece.of]

    def _tell(self) -> None:
        for name, done in [item for item in self._told if self.ready(item[0])]:
            self._told.remove((name, done))
            self._asked.pop(name, None)
            done(name)
