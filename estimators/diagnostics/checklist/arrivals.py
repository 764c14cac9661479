"""When readings were measured and when they came: rates, gaps and lateness of each sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...log import READING, Log
from ...model.state_space import StateSpaceModel

QUANTILES = (0.5, 0.99, 1.0)
"""Of lateness."""


class Arrivals(NamedTuple):
    """The readings of one sensor.

    `period` is the median time between two, s, and `rate` readings a second by it. `gap` is the longest time without
    one, s, which began at `gap_at` (s of the log); `missing` the share of readings that are not there, if the period
    always held, or that have no finite value. lateness (3,) holds the quantiles `QUANTILES` of arrival less measured
    time, s; NaN where arrivals are not known.
    """

    sensor: str
    n: int
    period: float
    rate: float
    gap: float
    gap_at: float
    missing: float
    lateness: np.ndarray


def arrivals(model: StateSpaceModel, log: Log) -> tuple[Arrivals, ...]:
    """Of every sensor of a model, also those that never speak (n = 0)."""
    t, kind, channel = log.t[: log.n], log.kind[: log.n], log.channel[: log.n]
    reading = kind == READING
    # A file says when something was measured; what arrives at the very time at which it was measured came from one.
    known = bool(np.any(log.arrival[: log.n][reading] != t[reading]))
    found = []
    for s, sensor in enumerate(model.sensors):
        own = np.flatnonzero(reading & (channel == s))
        there = np.isfinite(log.value[own, : len(sensor.rows)]).any(axis=1)
        times = np.unique(t[own[there]])
        apart = np.diff(times) * 1e-9
        late = np.full(len(QUANTILES), np.nan)
        if known and own.size:
            late = np.quantile((log.arrival[own] - t[own]) * 1e-9, QUANTILES)
        period, gap, at, missing = np.nan, np.nan, np.nan, np.nan
        if apart.size:
            period = float(np.median(apart))
            longest = int(np.argmax(apart))
            gap, at = float(apart[longest]), float(times[longest]) * 1e-9
            expected = np.round(apart.sum() / period) + 1.0
            missing = float(max(0.0, 1.0 - times.size / expected))
        rate = 1.0 / period if period > 0.0 else np.nan
        found.append(Arrivals(sensor.name, int(there.sum()), period, rate, gap, at, missing, late))
    return tuple(found)
