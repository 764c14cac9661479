"""Timing on a machine that others use too: processor time, repetitions interleaved, medians, ratios pair by pair."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median
from time import perf_counter, process_time
from typing import NamedTuple


class Pair(NamedTuple):
    """Median seconds of two things, and the median over the pairs of how many times longer the second took."""

    ours: float
    theirs: float
    ratio: float


def seconds(call: Callable[[], object]) -> float:
    """Seconds of the processor that one call takes (of the clock, if nobody else wanted it)."""
    begun = process_time()
    call()
    return process_time() - begun


def both(call: Callable[[], object]) -> tuple[float, float]:
    """Seconds of the clock and of the processor."""
    begun = perf_counter()
    spent = seconds(call)
    return perf_counter() - begun, spent


def medians(calls: Sequence[Callable[[], object]], repetitions: int) -> list[float]:
    """Median seconds of each call, A B C A B C …; each runs once unmeasured before."""
    for call in calls:
        call()
    rounds = [[seconds(call) for call in calls] for _ in range(repetitions)]
    return [median(column) for column in zip(*rounds, strict=True)]


def compare(
    ours: Callable[[], object], theirs: Callable[[], object], *, steps: tuple[int, int], repetitions: int
) -> Pair:
    """Seconds a step of both, A B A B; `steps` says how many each call does.

    A ratio is taken within each pair, so what slows the machine for longer than a pair slows both.
    """
    ours(), theirs()
    rounds = [(seconds(ours) / steps[0], seconds(theirs) / steps[1]) for _ in range(repetitions)]
    return Pair(median(a for a, _ in rounds), median(b for _, b in rounds), median(b / a for a, b in rounds))


def judged(value: float, bound: float, *, at_least: bool) -> str:
    """Whether a figure meets its bound, in words."""
    return "PASS" if (value >= bound if at_least else value <= bound) else "FALLS SHORT"
