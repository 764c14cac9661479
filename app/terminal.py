"""Signals that ask a program to end: it is let finish its files first."""

from __future__ import annotations

import io
import json
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from queue import Empty, SimpleQueue
from typing import TextIO, cast

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


def when_asked_to_end(end: Callable[[], object]) -> Mapping[int, Callable | int | None]:
    """Call `end`, which must take no lock, when one of them comes; gives what handled them before.

    One that is ignored stays so: who started the program with `nohup` wants it to outlive the terminal.
    """
    numbers = [getattr(signal, name) for name in ENDING if hasattr(signal, name)]
    return {
        number: signal.signal(number, lambda *_: end())
        for number in numbers
        if signal.getsignal(number) is not signal.SIG_IGN
    }


@contextmanager
def until_asked_to_end(stop: Callable[[], object] = lambda: None) -> Iterator[EndRequest]:
    """Context manager: yield the request to end; Ctrl-C ends the block, too. `stop` is called at its end, in any case.

    After `stop` the signals are handled as before.
    """
    done = EndRequest()
    previous = when_asked_to_end(done.set)
    try:
        yield done
    except KeyboardInterrupt:
        pass
    finally:
        stop()
        for number, handler in previous.items():
            signal.signal(number, handler)


def complain(text: object) -> None:
    """Print an error or warning."""
    if _lines_of_json:
        print_line("error", text)
    else:
        print(f"nisus: {printable(str(text))}", file=sys.stderr, flush=True)


_lines_of_json = False


def use_lines_of_json() -> None:
    """Print errors and notices as lines of JSON from now on, for services whose log is read by programs."""
    global _lines_of_json
    _lines_of_json = True


class JsonLines(io.TextIOBase):
    """Text file whose lines are printed as lines of JSON."""

    def __init__(self) -> None:
        self._rest = ""

    def write(self, text: str) -> int:
        """See `io.TextIOBase`."""
        *lines, self._rest = (self._rest + text).split("\n")
        for line in filter(None, lines):
            print_line("info", line)
        return len(text)


def messages_file() -> TextIO:
    """Return the file for messages about progress: standard error, or lines of JSON there."""
    return cast(TextIO, JsonLines()) if _lines_of_json else sys.stderr


def print_line(level: str, text: object, **fields: object) -> None:
    """Print a line of a log on standard error, with the present time (UTC); `fields` are added to one of JSON."""
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    if _lines_of_json:
        line = json.dumps({"time": now, "level": level, "text": str(text)} | fields)
    else:
        twin = f"{fields['twin']}: " if "twin" in fields else ""
        line = f"{now} {level.upper()} {twin}{printable(str(text))}"
    print(line, file=sys.stderr, flush=True)
