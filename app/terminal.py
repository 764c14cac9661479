"""Signals that ask a program to end: it is let finish its files first."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Mapping
from queue import Empty, SimpleQueue
from typing import Any

from estimators.errors import printable

ENDING = ("SIGTERM", "SIGHUP")  # from a service manager, and from a terminal that closes; Windows has the first only


class EndRequest:
    """A flag that a signal handler may set.

    A handler runs in the main thread between any two of its instructions, where that may hold the lock of a
    `threading.Event` it waits for: setting the event would then wait for itself. A `SimpleQueue` is reentrant.
    """

    def __init__(self) -> None:
        self._queue: SimpleQueue[None] = SimpleQueue()

    def set(self) -> None:
        """Ask to end."""
        self._queue.put(None)

    def wait(self, seconds: float) -> bool:
        """Return whether it has been set, at once or within this time; one thread may wait."""
        try:
            self._queue.get(timeout=seconds)
        except Empty:
            return False
        self.set()
        return True


def when_asked_to_end(end: Callable[[], Any]) -> Mapping[int, Any]:
    """Call `end`, which must take no lock, when one of them comes; gives what handled them before, for `restore`.

    One that is ignored stays so: who started the program with `nohup` wants it to outlive the terminal.
    """
    numbers = [getattr(signal, name) for name in ENDING if hasattr(signal, name)]
    return {
        number: signal.signal(number, lambda *_: end())
        for number in numbers
        if signal.getsignal(number) is not signal.SIG_IGN
    }


def restore(previous: Mapping[int, Any]) -> None:
    """Handle them as before."""
    for number, handler in previous.items():
        signal.signal(number, handler)


def complain(text: object) -> None:
    """Print an error or warning."""
    print(f"nisus: {printable(str(text))}", file=sys.stderr, flush=True)
