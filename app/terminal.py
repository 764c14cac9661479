"""Signals that ask a program to end: it is let finish its files first."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Mapping
from typing import Any

from estimators.errors import printable

ENDING = ("SIGTERM", "SIGHUP")
"""From a service manager, and from a terminal that closes; Windows has the first only."""


def when_asked_to_end(end: Callable[[], Any]) -> Mapping[int, Any]:
    """Call `end` when one of them comes; gives what handled them before, for `restore`.

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
