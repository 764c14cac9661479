"""Rows that repeat a measurement, or lie between two, by kind and by resolution in standard deviations of the noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from estimators.diagnostics.repeats import DEAD_BAND, HELD, LINEAR, SINGLE, STEPS, UNDECIDED
from tests.estimators.diagnostics.test_repeats import found, walk

from .timing import BenchmarkRow

STEPS_OF_NOISE = (0.0, 0.1, 0.5, 1.0, 2.0, 4.0, 10.0)
SEEDS = range(20)
Rows = Callable[[np.random.Generator, float, float], np.ndarray]


def held(period: float) -> Rows:
    """Return what makes 200 measurements, each written until the next."""

    def rows(rng: np.random.Generator, q: float, step: float) -> np.ndarray:
        at = (np.arange(200 * period) + rng.uniform()) / period
        return walk(rng, 201, q * period, step)[at.astype(int)]

    return rows


def irregular(rng: np.random.Generator, q: float, step: float) -> np.ndarray:
    """Each measurement is written 1 + a geometric number of times, 11 on average."""
    return np.repeat(walk(rng, 200, 11.0 * q, step), rng.geometric(0.1, 200) + 1)


def lines(rng: np.random.Generator, q: float, step: float) -> np.ndarray:
    """Rows on straight lines between every tenth of them, rounded like these."""
    y = np.interp(np.arange(1991) / 10.0, np.arange(200), walk(rng, 200, 10.0 * q, step))
    return np.round(y / step) * step if step else y


def partly(rng: np.random.Generator, q: float, step: float) -> np.ndarray:
    """A tenth of the rows are missing in runs of 20, and filled by straight lines."""
    y = walk(rng, 3000, q, step)
    known = np.ones(y.size, bool)
    for at in rng.choice(np.arange(50, 2950, 40), 15, replace=False):
        known[at : at + 20] = False
    y = np.interp(np.arange(y.size), np.flatnonzero(known), y[known])
    return np.round(y / step) * step if step else y


def dead_band(rng: np.random.Generator, q: float, step: float) -> np.ndarray:
    """A value is sent once it differs by 3σ from the last one."""
    sent = [20.0]
    for value in walk(rng, 4000, q, step):
        sent.append(value if abs(value - sent[-1]) >= 3.0 else sent[-1])
    return np.array(sent)


def repeats() -> Iterator[BenchmarkRow]:
    """Share of 60 constructed channels that is named right, %, by resolution in σ; of measurements, named falsely."""
    every: dict[str, tuple[Rows, tuple[str, ...]]] = {
        f"held for {period:g} rows": (held(period), (HELD,)) for period in (2, 2.5, 3, 5, 7.3, 10, 10.3, 30, 60, 100)
    }
    every |= {
        "held irregularly": (irregular, (STEPS, DEAD_BAND)),
        "straight lines": (lines, (LINEAR,)),
        "partly filled": (partly, (LINEAR,)),
        "dead band": (dead_band, (DEAD_BAND,)),
        "measured, undecided": (lambda rng, q, step: walk(rng, 3000, q, step), (UNDECIDED,)),
        "measured, false": (lambda rng, q, step: walk(rng, 3000, q, step), (HELD, STEPS, DEAD_BAND, LINEAR)),
    }
    for name, (rows, kinds) in every.items():
        figures = {}
        for step in STEPS_OF_NOISE:
            courses = [rows(np.random.default_rng(seed), q, step) for seed in SEEDS for q in (0.002, 0.02, 0.2)]
            figures[f"{step:g}"] = 100.0 * float(np.mean([found(y).kind in kinds for y in courses]))
        yield BenchmarkRow(name, figures, remark=f"else {SINGLE or 'each row a measurement'} or undecided")
