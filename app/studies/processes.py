"""Parallel worker processes that end with the command, also on Ctrl-C."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from estimators.compiled.orphan import leave_with_parent
from estimators.errors import ConfigError


def jobs_of(given: int | None, most: int) -> int:
    """Return the number of processes for --jobs: at most the number of calls, by default one per processor.

    Raises:
        ConfigError: If it is none.
    """
    if given is not None and given < 1:
        raise ConfigError(f"--jobs {given}: must be 1 or more")
    return min(most, given or os.cpu_count() or 1)


@contextmanager
def beside(
    work: Callable[..., Any], calls: Sequence[tuple[Any, ...]], jobs: int, begin: Callable[..., None], given: Any = ()
) -> Iterator[list[Future[Any]]]:
    """Call `work` with each of `calls`, its arguments, in this order; yield a future for each.

    There are so many processes as `jobs`; each begins with `begin`, called with `given`. Another process must find
    `work` in a module.
    """
    # Read when a process loads NumPy: threads that spin beside a small matrix would count as the work's cost.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Spawned: the libraries that the filters' threads come from do not survive a fork.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin, initargs=(begin, *given))
    try:
        # Ctrl-C is for the parent alone. What it starts inherits the mask, so that it holds while a process loads too.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            futures = [pool.submit(work, *call) for call in calls]
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        yield futures
    except BaseException:
        # The other results are not needed, and a fold may take minutes.
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    pool.shutdown()


def _begin(begin: Callable[..., None], *given: Any) -> None:
    leave_with_parent()
    begin(*given)
