"""Background jobs of a running twin: pools of threads for work that takes many folds and must not delay the engine.

A job is a function that takes its `Job`; it calls `check` or `rest` often, which end it once nobody wants the result.
"""

from __future__ import annotations

import heapq
import itertools
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, wait
from typing import Any, TypeVar

from estimators.errors import reason_of

from .notices import Notices

T = TypeVar("T")

MAX_JOBS = 3
"""Jobs that run at once; the others wait. A fit, an advice and a smoother may each take minutes."""

LOWEST_PRIORITY = 19
"""Niceness of the threads."""

STOP_TIMEOUT_S = 1.0

RUNNING, CANCELLING, CANCELLED, FAILED, DONE = "running", "cancelling", "cancelled", "failed", "done"


class JobCancelled(Exception):  # noqa: N818  no error: the result is not wanted
    """The job was cancelled, or its result is out of date."""


class Job:
    """Handle of one job: state, result, and cancellation.

    `state` is RUNNING from the moment of the request, then DONE with `result`, FAILED with `reason`, or CANCELLED; one
    of these three is final, and everything else is set before it.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[Job], Any] = lambda job: None,
        *,
        stale: Callable[[], bool] = lambda: False,
        every: float | None = None,
        failed: Callable[[str], object] = lambda reason: None,
    ) -> None:
        """See `Jobs.run`."""
        self.name, self.work, self.every, self.failed = name, work, every, failed
        self._stale = stale
        self._lock = threading.Lock()
        self._cancelled = threading.Event()
        self.state, self.reason = RUNNING, ""
        self.result: Any = None
        self.begun = time.monotonic()
        self._ended: float | None = None

    @property
    def over(self) -> bool:
        """Whether it has ended."""
        return self.state in (CANCELLED, FAILED, DONE)

    @property
    def elapsed(self) -> float:
        """Seconds from the request to the end, or until now."""
        return (time.monotonic() if self._ended is None else self._ended) - self.begun

    @property
    def cancelled(self) -> bool:
        """Whether it was asked to end."""
        return self._cancelled.is_set()

    @property
    def wanted(self) -> bool:
        """Whether the result is still wanted."""
        return not (self.cancelled or self._stale())

    def cancel(self) -> None:
        """Ask the job to end; it does so at its next `check`."""
        with self._lock:
            if not self.over:
                self.state = CANCELLING
            self._cancelled.set()

    def check(self) -> None:
        """Raise `JobCancelled` if the result is no longer wanted."""
        if not self.wanted:
            raise JobCancelled

    def rest(self, seconds: float) -> None:
        """Wait so many seconds; raise `JobCancelled` as soon as the job is cancelled."""
        self._cancelled.wait(seconds)
        self.check()

    def run(self) -> float | None:
        """Call the work once in this thread; return the seconds until the next call of a repeated job, else None."""
        answer, reason, state = None, "", DONE
        try:
            self.check()
            answer = self.work(self)
        except JobCancelled:
            state = CANCELLED
        except (Exception, SystemExit) as error:  # noqa: BLE001  a user's model may raise anything; the twin goes on
            state, reason = FAILED, reason_of(error)
        if state == FAILED:
            self.failed(reason)
        if self.every is not None and state != CANCELLED and not self.cancelled:
            return self.every if answer is None else float(answer)
        with self._lock:
            self.result, self.reason, self._ended = answer, reason, time.monotonic()
            self.state = state
        return None


class PacedExecutor(Executor):
    """Runs one item after another and rests after each as long as it took, so that it takes half a processor."""

    def __init__(self, job: Job) -> None:
        self._job = job

    def map(
        self, fn: Callable[..., T], *iterables: Iterable[object], timeout: float | None = None, chunksize: int = 1
    ) -> Iterator[T]:
        """Apply a function as the built-in `map` does; raise `JobCancelled` once the job is not wanted."""
        took = 0.0
        for items in zip(*iterables, strict=False):
            self._job.rest(took)
            begun = time.thread_time()
            yield fn(*items)
            took = time.thread_time() - begun


class Jobs:
    """Pool of threads, which start with the first job: started one by one they would look like a leak for an hour."""

    def __init__(
        self,
        notices: Notices,
        name: str = "job",
        *,
        threads: int = MAX_JOBS,
        niceness: int = LOWEST_PRIORITY,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare; jobs wait until `start`. Failures go to `notices`; `name` is that of the threads, numbered."""
        self._notices, self._name, self._clock = notices, name, clock
        self._limit, self._niceness = threads, niceness
        lock = threading.Lock()
        self._wake, self._earlier = threading.Condition(lock), threading.Condition(lock)
        self._led = False
        """Whether a thread waits at `_earlier` until the next job is due; the others wait at `_wake` for a notice."""
        self._queue: list[tuple[float, int, Job]] = []
        self._order = itertools.count()
        self._under_way: dict[Job, threading.Thread] = {}
        self._threads: list[threading.Thread] = []
        self._open = self._stopping = False

    def run(
        self,
        name: str,
        work: Callable[[Job], Any],
        *,
        stale: Callable[[], bool] = lambda: False,
        every: float | None = None,
        failed: Callable[[str], object] | None = None,
    ) -> Job:
        """Queue a job.

        Args:
            name: For notices.
            work: Called with the job, in a thread of the pool. What it returns is the job's `result`.
            stale: Whether the result is out of date; the job ends at its next `check` then.
            every: Seconds between two calls of a repeated job, which ends when it is cancelled; the work may return
                another number of seconds. None: one call.
            failed: Called with the reason if the work raises; by default that is a notice. A repeated job goes on.
        """

        def report(reason: str) -> None:
            self._notices.report(f"job {name}", f"{name}: {reason}", level="error", counted=False)

        job = Job(name, work, stale=stale, every=every, failed=failed or report)
        self._put(job, 0.0)
        return job

    def start(self) -> None:
        """Begin to run what is queued."""
        with self._wake:
            self._open = True
            self._hire()

    def stop(self) -> None:
        """Cancel all jobs, and wait up to `STOP_TIMEOUT_S` for those under way."""
        with self._wake:
            self._stopping = True
            for job in (*self._under_way, *(job for _, _, job in self._queue)):
                job.cancel()
            self._wake.notify_all()
            self._earlier.notify_all()
        end = time.monotonic() + STOP_TIMEOUT_S
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))

    def abandon(self) -> None:
        """Leave the jobs under way, which do not return, in their threads; continue with other threads."""
        with self._wake:
            self._threads = [thread for thread in self._threads if thread not in self._under_way.values()]
            self._hire()

    def step(self) -> bool:
        """Run the next job that is due in this thread; return whether there was one."""
        with self._wake:
            if not self._is_due():
                return False
            job = self._take()
        self._carry_out(job)
        return True

    def _put(self, job: Job, delay: float) -> None:
        with self._wake:
            entry = (self._clock() + delay, next(self._order), job)
            heapq.heappush(self._queue, entry)
            self._hire()
            if self._queue[0] is entry:
                (self._earlier if self._led else self._wake).notify()

    def _hire(self) -> None:
        """Start the threads that the pool lacks, if jobs wait."""
        while self._open and not self._stopping and self._queue and len(self._threads) < self._limit:
            thread = threading.Thread(target=self._serve, name=f"{self._name} {len(self._threads)}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def _is_due(self) -> bool:
        return bool(self._queue) and self._queue[0][0] <= self._clock()

    def _take(self) -> Job:
        job = heapq.heappop(self._queue)[2]
        self._under_way[job] = threading.current_thread()
        return job

    def _serve(self) -> None:
        if self._niceness and sys.platform == "linux":
            # Threads that a job starts inherit it.
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self._niceness)
        while True:
            with self._wake:
                while not self._stopping and not self._is_due():
                    if self._queue and not self._led:
                        self._led = True
                        self._earlier.wait(max(0.0, self._queue[0][0] - self._clock()))
                        self._led = False
                    else:
                        self._wake.wait()
                if self._stopping:
                    return
                job = self._take()
                if self._queue and not self._led:
                    self._wake.notify()
            self._carry_out(job)
            with self._wake:
                if threading.current_thread() not in self._threads:
                    return

    def _carry_out(self, job: Job) -> None:
        again = job.run()
        with self._wake:
            self._under_way.pop(job, None)
        if again is not None and math.isfinite(again):
            self._put(job, again)


class LoopThread(threading.Thread):
    """Daemon thread of a loop, which ends soon after `stopping` is set."""

    def __init__(self, run: Callable[[], object], name: str) -> None:
        """Prepare; nothing runs before `start`."""
        super().__init__(target=run, name=name, daemon=True)
        self.stopping = threading.Event()

    def stop(self, seconds: float | None = None, wake: Callable[[], object] = lambda: None) -> None:
        """Let the loop end, which `wake` wakes, and wait for that if it was started, no longer than so many seconds."""
        self.stopping.set()
        wake()
        if self.is_alive():
            self.join(seconds)


def run_all(*works: Callable[[], object]) -> None:
    """Run callables concurrently, the first in this thread, and wait for all.

    Raises:
        BaseException: The error of the first one that failed, in their order, once all are done.
    """
    begun = [start_in_thread(work, "one of several") for work in works[1:]]
    try:
        for work in works[:1]:
            work()
    finally:
        wait(begun)
    for outcome in begun:
        outcome.result()


def start_in_thread(work: Callable[[], T], name: str) -> Future[T]:
    """Call a function in a daemon thread of its own; the future has its result or error."""
    outcome: Future[T] = Future()
    threading.Thread(target=carry_out, args=(outcome, work), name=name, daemon=True).start()
    return outcome


def carry_out(outcome: Future[T], work: Callable[[], T]) -> None:
    """Call a function, and put its result or error into a future that is not cancelled."""
    if not outcome.set_running_or_notify_cancel():
        return
    try:
        outcome.set_result(work())
    except BaseException as error:  # noqa: BLE001  raised again by the future
        outcome.set_exception(error)
