"""Waiting for other threads and processes: one limit for every wait, which grows with the slowness of the machine."""

import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")

NOMINAL_S = 0.010
"""What `workload` takes on an idle core of a common machine."""

BASE_S = 180.0
"""Limit of a wait there; a step that works takes a fraction of it."""

WAITS_PER_TEST = 5
"""Limit of a whole test in limits of a wait: a test that hangs fails, and does not end the run."""


def workload() -> None:
    """Run a fixed piece of work in the interpreter."""
    total = 0
    for number in range(200_000):
        total += number & 7


def slowness() -> float:
    """Return the present duration of fixed work over its nominal one: processor, load and throttling; at least 1."""
    begun = time.perf_counter()
    repeats = 10
    for _ in range(repeats):
        workload()
    return max(1.0, (time.perf_counter() - begun) / (repeats * NOMINAL_S))


LIMIT_S = BASE_S * slowness()
"""For calls that take a limit of their own: `socket.settimeout`, `thread.join`, Playwright."""

TEST_LIMIT_S = WAITS_PER_TEST * LIMIT_S


def wait_for(condition: Callable[[], Found], every_s: float = 0.002) -> Found:
    """Poll until a condition holds, and return its value; what another thread or process does has no event to wait on.

    Raises:
        AssertionError: If it does not hold within the limit for the present load.
    """
    begun = time.monotonic()
    while not (found := condition()):
        waited = time.monotonic() - begun
        if waited > BASE_S and waited > BASE_S * slowness():
            raise AssertionError(f"the condition did not hold within {waited:.0f} s")
        time.sleep(every_s)
    return found
