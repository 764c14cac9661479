"""Run callables concurrently: an end that waits for many threads takes as long as the slowest, not as their sum."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any


def run_all(*works: Callable[[], Any]) -> None:
    """Run callables concurrently, the first in this thread, and wait for all.

    Raises:
        BaseException: The error of the first one that failed, once all are done.
    """
    failures: list[BaseException] = []

    def carry_out(work: Callable[[], Any]) -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001  raised again below, in the caller's thread
            failures.append(error)

    threads = [threading.Thread(target=carry_out, args=(work,), daemon=True) for work in works[1:]]
    for thread in threads:
        thread.start()
    for work in works[:1]:
        carry_out(work)
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]
