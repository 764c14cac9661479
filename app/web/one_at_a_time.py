"""Work that takes a while, in a thread of its own, never two at a time: the streams of all pages need the others."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from typing import TypeVar

from estimators.errors import ConfigError

PATIENCE = 15.0
"""Seconds that a question waits for the one before it."""

T = TypeVar("T")


class OneAtATime:
    """A queue for one kind of work. A model's function that never returns blocks this queue, and nothing else."""

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
            return await self._apart(work)
        finally:
            self._lock.release()

    async def _apart(self, work: Callable[[], T]) -> T:
        """As `asyncio.to_thread`, whose threads the process would wait for at its end."""
        loop = asyncio.get_running_loop()
        outcome: asyncio.Future[T] = loop.create_future()

        def settle(result: T | None, error: BaseException | None) -> None:
            if outcome.done():
                return
            if error is not None:
                outcome.set_exception(error)
            else:
                outcome.set_result(result)  # type: ignore[arg-type]

        def run() -> None:
            result, error = None, None
            try:
                result = work()
            except Exception as raised:  # noqa: BLE001  whoever asked is told
                error = raised
            # The server may have ended meanwhile.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(settle, result, error)

        threading.Thread(target=run, name=self._what, daemon=True).start()
        return await outcome
