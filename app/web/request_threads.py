"""Threads that carry out requests and messages of pages, so that the event loop waits for none of them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TypeVar

from anyio import CapacityLimiter, to_thread

T = TypeVar("T")

REQUEST_THREADS = 4
"""Threads for requests and files; AnyIO alone would start up to forty. The interpreter runs one at a time, and work
that takes long has a thread or a job of its own."""

ONE_AT_A_TIME = CapacityLimiter(1)
"""For the feeds of all Rerun viewers: Rerun's allocator keeps free memory for each thread that has used it at once."""


async def in_thread(
    work: Callable[..., T], *arguments: object, limiter: CapacityLimiter | None = None, **named: object
) -> T:
    """Return the result of work in one of the threads; it is awaited also when the task is cancelled meanwhile."""
    outcome = asyncio.ensure_future(to_thread.run_sync(partial(work, *arguments, **named), limiter=limiter))
    try:
        return await asyncio.shield(outcome)
    except asyncio.CancelledError:
        with suppress(Exception):
            await outcome
        raise


in_rerun_thread = partial(in_thread, limiter=ONE_AT_A_TIME)
