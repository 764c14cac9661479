"""Compile filters and models, and run long work with a status line."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from estimators.fold import Fold
from estimators.log import Log
from estimators.model.state_space import StateSpaceModel
from estimators.registry import ESTIMATORS, unfit
from sources.pieces import make, pieces_of

from ..engine.compile_queue import CompileQueue
from ..engine.compilers import Compiler
from ..engine.jobs import LoopThread, start_in_thread
from ..engine.watchdog import CallWatch, interruptible
from ..terminal import complain, messages_file
from ..twin.twin import Twin, load_twin
from .options import overrides_of

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T")

STATUS_DELAY_S = 1.0  # seconds before the line appears; loading from the cache takes less


def opened(arguments: Any, **others: str) -> Twin:
    """Return the twin that a command names, with its `--log`, `--set`, `--estimator` and `--tuning`, and `others`.

    Raises:
        NisusError: If its YAML or its model is wrong.
    """
    return load_twin(arguments.twin, log_files=arguments.log or None, overrides=overrides_of(arguments) | others)


def prepared(arguments: Any, **others: str) -> Twin:
    """Return the twin that a command names, see `opened`, once its filter and model are compiled."""
    twin = opened(arguments, **others)
    prepare(twin)
    return twin


def fold_log(twin: Twin, log: Log, *, picture: float | None = None, pairs: np.ndarray | None = None) -> Fold:
    """Fold a log to its end, so that Ctrl-C ends even a model function that does not return.

    Args:
        twin: The twin.
        log: The log.
        picture: Function that takes pictures of the estimate for a recording.
        pairs: Pairs of states whose covariance the track keeps, those of the twin's view first; None for these.
    """
    fold = twin.fold(
        log,
        pairs=twin.pairs if pairs is None else pairs,
        policy=twin.policy,
        picture=picture,
        expected=twin.expected,
    )

    def work() -> None:
        fold.advance()
        fold.finish()

    interruptible(fold, work)
    return fold


def prepare(twin: Twin) -> None:
    """Compile what a twin needs, once its source's files are known to fit.

    Raises:
        NisusError: If one does not, the model does not compile, or the estimator does not apply.
    """
    twin.check_files()
    compile_for(twin)


def compile_for(twin: Twin, compile_queue: CompileQueue | None = None) -> None:
    """Compile the twin's model and estimator, and what its source needs, or load them from the cache.

    A queue compiles everything but the model in other processes; the estimator may be ready only later.

    Raises:
        NisusError: If the model does not compile, or the estimator does not apply.
    """

    def work() -> None:
        twin.fold(pairs=twin.pairs, idle=compile_queue is not None)
        for name in twin.kernels:
            if compile_queue is not None:
                compile_queue.wait(name)
            else:
                for piece in pieces_of(name):
                    make(piece)

    what = "filters" if compile_queue is None else "the model"
    attend(twin.model, work, f"compiling {what}, once", f"compiled {what}, once")


def begin_to_compile(twin: Twin, workers: Sequence[Compiler] = ()) -> CompileQueue:
    """Let other processes compile missing cache entries: those of the source, the twin's filter, then all others.

    Those that do not apply to the twin are left out. `workers` are processes that were started before.
    """
    filters = [name for name, entry in ESTIMATORS.items() if unfit(entry, twin.model) is None]
    compile_queue = CompileQueue([*twin.kernels, *filters], workers=workers)
    for name in (*twin.kernels, twin.estimator):
        compile_queue.request(name)
    compile_queue.start()
    return compile_queue


def attend(
    model: StateSpaceModel | None,
    work: Callable[[], T],
    doing: str,
    done: str | None = None,
    *,
    text: Callable[[], str] = str,
    stop: Callable[[], object] | None = None,
) -> T:
    """Do work that runs a model, in a thread that may be left behind, so that Ctrl-C ends even a call without end.

    Args:
        model: Whose function is named on standard error if it does not return; None for a model of Nisus itself.
        work: Function to call.
        doing: Status shown while it runs long.
        done: Message printed when it has finished.
        text: Progress, appended to the status.
        stop: Called on the first Ctrl-C, after which the work returns what it has found; the second one ends it.

    Returns:
        The result of the work.

    Raises:
        BaseException: As the work.
    """
    begun = time.monotonic()

    def status() -> str:
        return f"{doing}: {time.monotonic() - begun:.0f} s{text() and ', '}{text()}"

    over = start_in_thread(work, "compile")
    while not over.done():
        try:
            if wait([over], STATUS_DELAY_S).not_done:
                _watch(over, None if model is None else CallWatch(model), status, f"{doing} ...")
                if done is not None:
                    _console().print(f"{done}: {time.monotonic() - begun:.0f} s", highlight=False)
        except KeyboardInterrupt:
            if stop is None:
                raise
            stop()
            stop = None
            complain("interrupted; the best result so far follows. Press Ctrl-C again to end at once.")
    return over.result()


def _watch(over: Future[T], watch: CallWatch | None, text: Callable[[], str], first: str) -> None:
    """Show what a thread does until it is over, and name a function of the model that does not return."""
    console = _console()
    with _shown(text, console, first):
        while wait([over], 0.5).not_done:
            line = None if watch is None else watch.check()
            if line is not None:
                console.print(line, highlight=False, soft_wrap=True)


LINE_PERIOD_S = 5.0  # seconds between two lines where output is no terminal


def _console() -> Console:
    from rich.console import Console

    return Console(file=messages_file())


@contextmanager
def _shown(text: Callable[[], str], console: Console, first: str = "") -> Iterator[None]:
    """Show a text that changes: as a status line in a terminal, as a line every `LINE_PERIOD_S` elsewhere."""
    if not console.is_terminal:
        if first:
            console.print(first, highlight=False, soft_wrap=True)
        with _every(LINE_PERIOD_S, lambda: print(text(), file=console.file, flush=True)):
            yield
        return
    with console.status(text()) as status, _every(0.5, lambda: status.update(text())):
        yield


@contextmanager
def _every(seconds: float, call: Callable[[], object]) -> Iterator[None]:
    """Call a function at intervals, in a thread of its own."""

    def run() -> None:
        while not thread.stopping.wait(seconds):
            call()

    thread = LoopThread(run, "progress")
    thread.start()
    try:
        yield
    finally:
        thread.stop()


@contextmanager
def progress(
    title: str, total: int, unit: str, *, clock: Callable[[], float] = time.monotonic
) -> Iterator[Callable[..., None]]:
    """Show how many of `total` units are done; yields the function to call after each, with the best result so far."""
    done, best, begun = 0, "", clock()

    def advance(result: str = "") -> None:
        nonlocal done, best
        done, best = done + 1, result

    def text() -> str:
        return progress_text(title, done, total, unit, clock() - begun) + (f"; {best}" if best else "")

    with _shown(text, _console()):
        yield advance


def progress_text(title: str, done: int, total: int, unit: str, seconds: float) -> str:
    """`lorenz63: 3 of 12 filters after 30 s, about 90 s left`, if those to come take as long as those done."""
    text = f"{title}: {done} of {total} {unit} after {seconds:.0f} s"
    if not done:
        return text
    left = seconds / done * (total - done)
    return f"{text}, about {f'{left:.0f} s' if left < 100.0 else f'{left / 60.0:.0f} min'} left"
