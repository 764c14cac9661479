"""Progress of long work on standard error: a bar in a terminal, elsewhere a line every few seconds."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.progress import Progress

LINE_PERIOD_S = 10.0  # seconds between two lines


@contextmanager
def progress(title: str, total: int, unit: str) -> Iterator[Callable[[], None]]:
    """Show how many of `total` units are done; yields the function to call after each."""
    console = Console(stderr=True)
    if not console.is_terminal:
        with lines(title, total, unit) as advance:
            yield advance
        return
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda: bar.advance(task)


@contextmanager
def lines(
    title: str,
    total: int,
    unit: str,
    *,
    every: float = LINE_PERIOD_S,
    clock: Callable[[], float] = time.monotonic,
    file: TextIO | None = None,
) -> Iterator[Callable[[], None]]:
    """Print plain lines, one every `every` seconds."""
    ended = threading.Event()
    done = [0]
    begun = clock()

    def say() -> None:
        while not ended.wait(every):
            print(line(title, done[0], total, unit, clock() - begun), file=file or sys.stderr, flush=True)

    def advance() -> None:
        done[0] += 1

    thread = threading.Thread(target=say, name="progress", daemon=True)
    thread.start()
    try:
        yield advance
    finally:
        ended.set()
        thread.join()


def line(title: str, done: int, total: int, unit: str, seconds: float) -> str:
    """`lorenz63: 3 of 12 filters after 30 s, about 90 s left`, if those to come take as long as those done."""
    text = f"{title}: {done} of {total} {unit} after {seconds:.0f} s"
    return f"{text}, about {seconds / done * (total - done):.0f} s left" if done else text
