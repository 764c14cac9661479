"""Work in parallel: in processes that end with the command, also on Ctrl-C, or on a cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING, Any, TypeVar

import numba

from config.extensions import maker
from estimators.compiled.orphan import leave_with_parent
from estimators.errors import ConfigError

if TYPE_CHECKING:
    from ..twin.twin import Twin

T = TypeVar("T")


def jobs_of(given: int | None, most: int) -> int:
    """Return the number of processes for --jobs: at most the number of calls, by default one per processor.

    Raises:
        ConfigError: If it is none.
    """
    if given is not None and given < 1:
        raise ConfigError(f"--jobs {given}: must be 1 or more")
    return min(most, given or os.cpu_count() or 1)


def results(
    work: Callable[..., T],
    calls: Sequence[tuple[object, ...]],
    *,
    jobs: int | None = None,
    cluster: str | None = None,
    begin: Callable[..., None] | None = None,
    given: tuple[object, ...] = (),
) -> Iterator[tuple[int, T]]:
    """Call `work` with each of `calls`, its arguments; yield index and result of each as it is done.

    Each process has one thread of Numba. The results are the same bits for any number of processes.

    Args:
        work: A function of a module: other processes import it.
        calls: Arguments, begun in this order.
        jobs: Number of processes; None for one per processor. If it is one, `work` is called in this process.
        cluster: Address of a Dask scheduler, or `local:N` for a cluster of N processes on this machine. Calls of a
            worker that dies are made again by another.
        begin: Called with `given` in each process before its first call; a function of a module, too.
        given: Its arguments.

    Raises:
        ConfigError: If a number is wrong, Dask is not installed, or the cluster does not answer, has another version,
            or loses its scheduler or its workers.
    """
    begin = begin or _nothing
    if cluster is None and (jobs := jobs_of(jobs, len(calls))) == 1:
        threads = numba.get_num_threads()
        try:
            _begin(begin, *given)
            yield from ((k, work(*call)) for k, call in enumerate(calls))
        finally:
            numba.set_num_threads(threads)
        return
    if cluster is not None and jobs is not None:
        raise ConfigError("--jobs: counts processes of this command; the cluster has its own (leave one option out)")
    with _processes(jobs or 1, begin, given) if cluster is None else _elsewhere("calls", cluster, begin, given) as pool:
        futures = {pool.submit(work, *call): k for k, call in enumerate(calls)}
        yield from ((futures[future], future.result()) for future in as_completed(futures))


def executor_of(
    cluster: str | None, twin: Twin, held: Twin, name: str, overrides: Mapping[str, str]
) -> AbstractContextManager[Executor | str]:
    """Return a context manager: an Executor on a cluster whose workers load a twin, or "threads" without a cluster.

    Args:
        cluster: See `results`; None for none.
        twin: The twin whose folds are called.
        held: The same with its considered parameters held, see `with_held`.
        name: Its name or path, as the workers load it.
        overrides: As of `load_twin`.

    Raises:
        ConfigError: As `results`.
    """
    return nullcontext("threads") if cluster is None else _elsewhere("folds", cluster, twin, held, name, overrides)


def _elsewhere(kind: str, cluster: str, *given: object) -> AbstractContextManager[Any]:
    return maker("executors", kind, f"--cluster {cluster}", "cluster")(cluster, *given)


class _Deaf:
    """Processes of this machine, which do not hear Ctrl-C."""

    def __init__(self, pool: Executor) -> None:
        self._pool = pool

    def submit(self, work: Callable[..., T], *call: object) -> Future[T]:
        """Submit a call, for which a process may be started."""
        with deaf():
            return self._pool.submit(work, *call)


@contextmanager
def _processes(jobs: int, begin: Callable[..., None], given: tuple[Any, ...]) -> Iterator[_Deaf]:
    # Read when a process loads NumPy: threads that spin beside a small matrix would count as the work's cost.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Spawned: the libraries that the filters' threads come from do not survive a fork.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin_child, initargs=(begin, *given))

    try:
        yield _Deaf(pool)
    except BaseException:
        # The other results are not needed, and a fold may take minutes.
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    pool.shutdown()


@contextmanager
def deaf() -> Iterator[None]:
    """Block Ctrl-C for processes that are started here: they inherit the mask, also while they load."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _nothing() -> None:
    pass


def _begin_child(begin: Callable[..., None], *given: Any) -> None:
    leave_with_parent()
    _begin(begin, *given)


def _begin(begin: Callable[..., None], *given: object) -> None:
    begin(*given)
    numba.set_num_threads(1)  # the processors have a call each, and a step costs what it costs one
