"""The shape of the posterior: several peaks, or one peak and noise with heavy tails?

Peaks are those of a cloud of particles along the log. Tails are those of the innovations of the filter in use, each in
units of its own standard deviation: a scale that is wrong makes no tails.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..fold import Fold
from ..log import READING, Log
from ..model.state_space import StateSpaceModel
from ..registry import find_entry, unfit
from ..snapshots import Base
from ..track import GATED, USED, Track
from ..tuning import Tuning
from .calibration import standardised
from .whiteness import jarque_bera

LOOKS = 150
"""Times at which the cloud is looked at; finding its peaks takes milliseconds."""

MOST_STATES = 12
"""Of a cloud: beyond, particles that explain a reading become too rare for its shape to say anything."""

MOST_EVENTS = 4000

OFTEN = 0.05
"""Share of the looks with more than one peak, from which on the posterior has several."""

HEAVY = 1.0
"""Excess kurtosis that matters: that of Student's t with ten degrees of freedom."""

FAR = 4.0
"""Standard deviations beyond which a normal innovation lies once in 16,000 readings."""

LEAST = 50
"""Readings of which a kurtosis is taken at least."""


class Peaks(NamedTuple):
    """Of a cloud, at `looks` times: share of them with more than one peak, and the most there were.

    `reason` says why there is no cloud. `recoveries` counts how often the cloud lost the asset: then its shape says
    little. `over`: seconds of the log.
    """

    estimator: str
    reason: str
    looks: int
    several: float
    most: int
    recoveries: int
    over: float


class Tail(NamedTuple):
    """Excess kurtosis of a row's n innovations, their share beyond 4 σ, p-value of Jarque-Bera."""

    row: str
    n: int
    kurtosis: float
    far: float
    p_value: float

    @property
    def heavy(self) -> bool:
        """Whether the tails are heavier than a normal distribution's by more than matters."""
        return self.n >= LEAST and self.kurtosis > HEAVY


def peaks(estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log, *, base: Base | None = None) -> Peaks:
    """Fold the first part of a log with particles, and look at the cloud on the way.

    Args:
        estimator: A particle filter.
        model: Of at most 12 states.
        tuning: With the options of that filter.
        log: The events; it must not grow meanwhile (give a copy).
        base: Where the log starts, if older events were dropped.

    Raises:
        EstimatorError: As `Fold`.
        ModelError: As `Fold`.
    """
    reason = unfit(find_entry(estimator), model) or ""
    if not reason and model.nx > MOST_STATES:
        reason = f"{model.nx:,} states are too many for particles, whose number grows exponentially with them"
    if reason:
        return Peaks(estimator, reason, 0, np.nan, 0, 0, 0.0)
    fold = Fold(estimator, model, tuning, log, base=base)
    end = min(log.n, MOST_EVENTS)
    counts = []
    for stop in np.unique(np.linspace(1, end, min(end, LOOKS)).round().astype(int)):
        fold.advance(int(stop) - fold.n)
        counts.append(len(fold.peaks()))
    over = float(log.t[end - 1] - log.t[0]) * 1e-9
    several = float(np.mean(np.array(counts) > 1))
    return Peaks(estimator, "", len(counts), several, max(counts), fold.recoveries(), over)


def tails(model: StateSpaceModel, log: Log, track: Track, *, marginal: bool) -> tuple[Tail, ...]:
    """Of every sensor row with readings that were used or refused; `marginal` as in calibration.py."""
    judged = (log.kind[: len(track)] == READING) & ((track.verdict == USED) | (track.verdict == GATED))
    found = []
    for s, sensor in enumerate(model.sensors):
        own = track.select(np.flatnonzero(judged & (log.channel[: len(track)] == s)))
        for k in range(len(sensor.rows)):
            e = standardised(own, k, marginal)
            e = e[np.isfinite(e)]
            z = e - np.mean(e) if e.size else e
            variance = float(np.mean(z**2)) if z.size else 0.0
            if variance > 0.0:
                kurtosis = float(np.mean(z**4)) / variance**2 - 3.0
                far = float(np.mean(np.abs(z) > FAR * np.sqrt(variance)))
                name = model.row_names[model.row_start[s] + k]
                found.append(Tail(name, int(e.size), kurtosis, far, jarque_bera(e).p_value))
    return tuple(found)
