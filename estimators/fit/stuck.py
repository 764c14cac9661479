"""Readings of a sensor that was stuck take no part in a fit: it predicts itself, so that its R would run to nothing.

Two readings of standard deviation σ, rounded to a quantum q, are equal with a probability of erf(q / 2σ) at most,
whatever was measured, and an asset at rest repeats itself more often: the share of its repetitions in all other runs
counts if it is larger. A run of repetitions that would come by chance in one of a thousand such logs is too long. It
is the test of the running twin (diagnostics/evidence/row_tests.py), over the whole log at once. Runs that are a small
share of the readings stay: an asset at rest has many, and they hardly change what is fitted.
"""

from __future__ import annotations

import math

import numpy as np

from ..log import READING, Log
from ..tuning import Tuning

RARE = 1e-3
"""Logs in which chance brings such a run."""

SHARE = 0.05
"""Of the readings of a sensor that a run has, at least: with fewer its R is off by less than its interval is wide."""

LEAST = 0.01
"""Probability of a repetition that is granted at least."""


def unstuck(tuning: Tuning, log: Log) -> tuple[Log, dict[str, int]]:
    """The log without the repetitions of sensors that were stuck, and how many these are, by sensor.

    A sensor that never says anything else is left as it is: its R is not fitted in any case.
    """
    model, kind = tuning.model, log.kind[: log.n]
    kept, found = np.ones(log.n, bool), {}
    for s, sensor in enumerate(model.sensors):
        own = np.flatnonzero((kind == READING) & (log.channel[: log.n] == s))
        first, count = model.row_start[s], len(sensor.rows)
        rows = [
            repeated(log.value[own, k], math.sqrt(tuning.r[first + k]))
            for k in range(count)
            if np.isfinite(log.value[own, k]).any()
        ]
        # A receiver that stands still may repeat one of its rows.
        stuck = np.logical_and.reduce(rows) if rows and tuning.used[s] else np.zeros(own.size, bool)
        if stuck.any():
            kept[own[stuck]] = False
            found[sensor.name] = int(stuck.sum())
    if not found:
        return log, {}
    rest = log.copy()
    rest.n = 0
    rest._insert(log.events.select(kept))
    return rest, found


def repeated(values: np.ndarray, std: float) -> np.ndarray:
    """Which of the values (n,) of a row repeat the one before in a run that is too long for chance, (n,).

    What is missing neither repeats nor interrupts.
    """
    there = np.isfinite(values)
    found = np.zeros(values.size, bool)
    found[there] = _repeated(values[there], std)
    return found


def _repeated(values: np.ndarray, std: float) -> np.ndarray:
    found = np.zeros(values.size, bool)
    steps = np.abs(np.diff(values))
    if not np.any(steps == 0.0) or not np.any(steps > 0.0):
        return found
    quantum = float(steps[steps > 0.0].min())
    by_noise = math.erf(0.5 * quantum / std) if std > 0.0 else 1.0
    # Where a run of repetitions begins, and how many it has.
    edges = np.flatnonzero(np.diff((steps == 0.0).astype(np.int8), prepend=0, append=0)) + 1
    begins, lengths = edges[::2], edges[1::2] - edges[::2]
    others = (lengths.sum() - lengths) / np.maximum(1, steps.size - lengths)
    chance = np.minimum(np.maximum(others, max(by_noise, LEAST)), 1.0)
    with np.errstate(divide="ignore"):
        longest = np.maximum(SHARE * values.size, math.log(values.size / RARE) / -np.log(chance))
    for begin, length in zip(begins[lengths >= longest], lengths[lengths >= longest], strict=True):
        found[begin : begin + length] = True
    return found
