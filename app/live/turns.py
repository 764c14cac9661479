"""A lock that goes to whoever waits: a thread that lets it go and takes it again at once comes after them.

The engine folds what has come in pieces and lets readers in between them; with an ordinary lock it would have the lock
again before they wake.
"""

from __future__ import annotations

import threading
from typing import Any


class Turns:
    """Held by one thread at a time. Whoever is next stands at the door, and all others behind."""

    def __init__(self) -> None:
        self._door, self._lock = threading.Lock(), threading.Lock()

    def acquire(self, timeout: float = -1) -> bool:
        """Take it, within so many seconds at the door and as many before it; whether that was possible."""
        if not self._door.acquire(timeout=timeout):
            return False
        try:
            return self._lock.acquire(timeout=timeout)
        finally:
            self._door.release()

    def release(self) -> None:
        """Let it go."""
        self._lock.release()

    def __enter__(self) -> None:
        self.acquire()

    def __exit__(self, *_: Any) -> None:
        self.release()
