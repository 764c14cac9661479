"""Recordings to fit to: held-out blocks of time, readings of stuck sensors, events that a fit does not need.

One fold runs through all blocks, since the state must come from somewhere; only which readings count differs. Every
reading is judged by its prediction from the readings before it (Dawid 1984, doi:10.2307/2981683), so the held-out
blocks are predictions of data that took no part in the fit.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..diagnostics.detectors import STUCK
from ..fold import folded
from ..log import INPUT, MAINTENANCE, READING, RESET, TRUTH, Log
from ..snapshots import Base
from ..tuning import Tuning

BLOCKS = 9  # Default number of blocks per log
HELD_OUT_EVERY = 3  # Every third block is held out, the last one too: a fit is used on data that come after it
RUN_PROBABILITY = 1e-3  # Probability by chance of a run of repetitions that is long enough to count as stuck, per log

MIN_RUN_SHARE = 0.05
"""Smallest share of a sensor's readings in a run that counts: a shorter run biases R by less than its interval."""

MIN_REPEAT_PROBABILITY = 0.01  # Lower bound of the probability that a reading repeats


class Recording(NamedTuple):
    """A log to fit to.

    Attributes:
        log: The events.
        weight: Factor on the log density of its readings.
        held_out: Mask (n,) of the events that take no part in the fit; `fit` fills it.
        base: Where a fold of the log starts; None for the prior.
    """

    log: Log
    weight: float = 1.0
    held_out: np.ndarray = np.zeros(0, bool)
    base: Base | None = None


def held_out_rows(log: Log, blocks: int = BLOCKS) -> np.ndarray:
    """Return the mask (n,) of the events in held-out blocks; none where `blocks` is 0.

    All blocks have the same number of readings, so that each carries about as much information.
    """
    reading = log.events.kind == READING
    count = int(reading.sum())
    if not blocks or count < blocks:
        return np.zeros(log.n, bool)
    # Events after the last reading belong to its block.
    block = np.minimum((np.cumsum(reading) - reading) * blocks // count, blocks - 1)
    return block % HELD_OUT_EVERY == HELD_OUT_EVERY - 1


def until_last_fitted(recording: Recording) -> Recording:
    """Return the recording up to the last event that takes part in the fit; nothing later changes its objective."""
    n = int(np.flatnonzero(~recording.held_out)[-1]) + 1
    log = _selected(recording.log, np.arange(recording.log.n) < n)
    return recording._replace(log=log, held_out=recording.held_out[:n])


def without_queries(log: Log, *, truth: bool = False) -> Log:
    """Return the log without queries, which never change the estimate; true states stay if `truth`.

    The first event always stays: the prior holds at its time.
    """
    kept = np.isin(log.events.kind, (READING, INPUT, RESET, MAINTENANCE, *((TRUTH,) if truth else ())))
    if not kept.any():
        return log
    kept[0] = True
    return _selected(log, kept)


def without_stuck(estimator: str, tuning: Tuning, log: Log, base: Base | None = None) -> tuple[Log, dict[str, int]]:
    """Return the log without the repetitions of stuck sensors, and their number by sensor.

    A stuck sensor predicts itself, so its fitted R would tend to zero. Two readings of standard deviation σ, rounded to
    a quantum q, are equal with a probability of at most erf(q / 2σ), and an asset at rest repeats more often: the share
    of repetitions in all other runs counts if it is larger. A run is stuck if its probability is below
    `RUN_PROBABILITY`, and if the detector of the running twin (diagnostics/detector_tests.py) is in alarm in it: an
    asset at rest repeats itself, too. A sensor that never changes is left as it is: its R is not fitted in any case.
    """
    model = tuning.model
    kept, counts, fold = np.ones(log.n, bool), {}, None
    for s, sensor in enumerate(model.sensors):
        own = log.events.of_sensor(s)
        first = model.row_start[s]
        rows = [
            repeated(log.value[own, k], math.sqrt(tuning.r[first + k]))
            for k in range(len(sensor.rows))
            if np.isfinite(log.value[own, k]).any()
        ]
        # All rows must repeat: a receiver at rest may repeat one of them.
        stuck = np.logical_and.reduce(rows) if rows and tuning.used[s] else np.zeros(own.size, bool)
        if not stuck.any():
            continue
        if fold is None:
            fold = folded(estimator, model, replace(tuning, baseline=None), log, base=base)
        alarms = (fold.track.alarms[own, : len(sensor.rows)] & STUCK != 0).any(axis=1)
        run = np.cumsum(np.diff(stuck.astype(np.int8), prepend=0) == 1) * stuck
        stuck &= np.isin(run, run[alarms & stuck])
        if stuck.any():
            kept[own[stuck]] = False
            counts[sensor.name] = int(stuck.sum())
    return (_selected(log, kept), counts) if counts else (log, {})


def repeated(values: np.ndarray, std: float) -> np.ndarray:
    """Return the mask (n,) of values that belong to a run of repetitions too long for chance.

    Args:
        values: Readings of one row (n,); NaNs neither repeat nor interrupt a run.
        std: Standard deviation of the sensor's noise, in the unit of `values`.
    """
    present = np.flatnonzero(np.isfinite(values))
    found = np.zeros(values.size, bool)
    steps = np.abs(np.diff(values[present]))
    if not np.any(steps == 0.0) or not np.any(steps > 0.0):
        return found
    quantum = float(steps[steps > 0.0].min())
    by_noise = math.erf(0.5 * quantum / std) if std > 0.0 else 1.0
    # First repetition of each run, and its length.
    edges = np.flatnonzero(np.diff((steps == 0.0).astype(np.int8), prepend=0, append=0)) + 1
    begins, lengths = edges[::2], edges[1::2] - edges[::2]
    others = (lengths.sum() - lengths) / np.maximum(1, steps.size - lengths)
    chance = np.minimum(np.maximum(others, max(by_noise, MIN_REPEAT_PROBABILITY)), 1.0)
    with np.errstate(divide="ignore"):
        limit = np.maximum(MIN_RUN_SHARE * present.size, math.log(present.size / RUN_PROBABILITY) / -np.log(chance))
    for begin, length in zip(begins[lengths >= limit], lengths[lengths >= limit], strict=True):
        found[present[begin : begin + length]] = True
    return found


def _selected(log: Log, rows: np.ndarray) -> Log:
    """Return a log of some of the events."""
    kept = log.copy()
    kept.n = 0
    kept._insert(log.events.select(rows))
    return kept
