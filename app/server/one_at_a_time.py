"""Work that takes a while, in threads that are never more than one: the streams of all pages need the others."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

from estimators.errors import ConfigError

PATIENCE = 15.0
"""Seconds that a question waits for the one before it."""

T = TypeVar("T")


class OneAtATime:
    """A queue for one kind of work, which a model's function that never returns blocks, and nothing else."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._lock = asyncio.Lock()

    async def do(self, work: Callable[[], T]) -> T:
        """The result of work in a thread, once that before it is done.

        Raises:
            ConfigError: If that takes too long.
        """
        try:
            await asyncio.wait_for(self._lock.acquire(), PATIENCE)
        except TimeoutError:
            raise ConfigError(f"{self._what}: another one is under way; ask again") from None
        try:
            return await asyncio.to_thread(work)
        finally:
            self._lock.release()
