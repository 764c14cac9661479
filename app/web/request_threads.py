"""Threads that carry out requests and messages of pages, so that the event loop waits for none of them."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

from ..engine.jobs import Jobs, carry_out
from ..engine.notices import Notices

T = TypeVar("T")

REQUEST_THREADS = 12
"""Threads for requests. One page with the scene and an edit under way uses six at once; work that takes long has a
thread or a job of its own."""


class RequestThreads:
    """Fixed number of daemon threads with one queue; all start with the first request.

    AnyIO, which Starlette uses, starts and ends its threads with the load, two to forty of them, each with a stack and
    heaps of its own.
    """

    def __init__(self, name: str, count: int) -> None:
        """Prepare `count` threads of a name; nothing is started yet."""
        self._jobs = Jobs(Notices(time.time_ns), name, threads=count, niceness=0)
        self._jobs.start()

    def submit(self, work: Callable[[], T]) -> Future[T]:
        """Queue work; the result or the error is set in the future."""
        outcome: Future[T] = Future()
        self._jobs.run("request", lambda job: carry_out(outcome, work))
        return outcome

    async def run(self, work: Callable[..., T], *arguments: Any, **named: Any) -> T:
        """Return the result of work in one of the threads; it is awaited also when the task is cancelled meanwhile."""
        outcome = asyncio.wrap_future(self.submit(partial(work, *arguments, **named)))
        try:
            return await asyncio.shield(outcome)
        except asyncio.CancelledError:
            with suppress(Exception):
                await outcome
            raise


in_thread = RequestThreads("request", REQUEST_THREADS).run

in_rerun_thread = RequestThreads("rerun", 1).run
"""For the feeds of all Rerun viewers: Rerun's allocator keeps free memory for each thread that has used it, so Explore
took 15 MB more in twelve threads."""
