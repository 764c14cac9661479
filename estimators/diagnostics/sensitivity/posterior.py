"""Shape of the posterior: several peaks, or one peak and heavy-tailed noise.

A peak counts if two particle clouds with different seeds share it. Tails are those of the standardised innovations of
the filter in use, relative to their own standard deviation.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...fold import Fold
from ...log import READING, Log
from ...model.state_space import StateSpaceModel
from ...numerics.linalg import wrapped
from ...numerics.peaks import Peak
from ...registry import find_entry, unfit
from ...track import GATED, USED, Track
from ...tuning import Tuning
from ..calibration import standardised
from ..innovations import jarque_bera

MAX_LOOKS = 150  # Times at which the cloud is sampled; finding its peaks takes milliseconds

MOST_STATES = 12
"""States up to which the shape of a particle cloud is informative: beyond, too few particles explain a measurement."""

MOST_EVENTS = 4000

DISTINCT_SHARE = 0.2  # Share of a cloud's members that must differ after a reading; of fewer, clusters are of chance
COLLAPSED_SHARE = 0.5  # Share of looks at a collapsed cloud from which its shape is not informative
MIN_PEAK_WEIGHT = 0.001  # Share of the other cloud that a peak must have there, too
NEAR_SIGMA = 3.0  # Standard deviations in each state, within which a point belongs to a peak
PEAK_DIP = 0.5  # Share of the points at either end, of which there must be fewer in the middle between two peaks
FREQUENT_SHARE = 0.05  # Share of the looks with more than one peak, from which on the posterior has several
HEAVY_KURTOSIS = 1.0  # Excess kurtosis that matters: that of Student's t with ten degrees of freedom
FAR_SIGMA = 4.0  # Standard deviations beyond which a normal innovation lies once in 16,000 readings
MIN_TAIL_MEASUREMENTS = 50  # Readings of which a kurtosis is taken at least


class Peaks(NamedTuple):
    """Peaks of a particle cloud at `looks` times: share with more than one peak, and their largest number.

    collapsed: share of times at which too few particles differ for peaks to be informative; they do not count. reason:
    why peaks are not computed, or "". recoveries: times that the cloud lost the asset; its shape is then hardly
    informative. over: seconds of the log.
    """

    estimator: str
    reason: str
    looks: int
    several: float
    most: int
    recoveries: int
    over: float
    collapsed: float = 0.0


class Tail(NamedTuple):
    """Excess kurtosis of a row's n innovations, their share beyond 4 σ, p-value of Jarque-Bera."""

    row: str
    n: int
    kurtosis: float
    far: float
    p_value: float

    @property
    def heavy(self) -> bool:
        """Whether the tails are considerably heavier than those of a normal distribution."""
        return self.n >= MIN_TAIL_MEASUREMENTS and self.kurtosis > HEAVY_KURTOSIS


def peaks(estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log) -> Peaks:
    """Fold the first part of a log with two particle filters, and count the peaks of their clouds.

    Args:
        estimator: A particle filter.
        model: Model with at most 12 states.
        tuning: Tuning with the options of that filter.
        log: The events; it must not grow meanwhile (give a copy).

    Raises:
        EstimatorError: As `Fold`.
        ModelError: As `Fold`.
    """
    reason = unfit(find_entry(estimator), model) or ""
    if not reason and model.nx > MOST_STATES:
        reason = f"{model.nx:,} states are too many for particles, whose number grows exponentially with them"
    if reason:
        return Peaks(estimator, reason, 0, np.nan, 0, 0, 0.0)
    end = min(log.n, MOST_EVENTS)
    # Right after a measurement: later, process noise separates duplicated particles.
    stops = np.flatnonzero(log.kind[:end] == READING) + 1
    stops = stops[np.unique(np.linspace(0, stops.size - 1, min(stops.size, MAX_LOOKS)).round().astype(int))]
    folds = [Fold(estimator, model, replace(tuning, seed=tuning.seed + k), log) for k in range(2)]
    counts = []
    for stop in stops:
        for fold in folds:
            fold.advance(int(stop) - fold.n)
        points, other = (fold.points() for fold in folds)
        varied = len(np.unique(points, axis=0)) >= DISTINCT_SHARE * len(points)
        counts.append(_confirmed(folds[0].peaks(), other, model.circular) if varied else 0)
    over = float(log.t[end - 1] - log.t[0]) * 1e-9
    found = np.array(counts, int)
    collapsed = float(np.mean(found == 0)) if found.size else 0.0
    if collapsed > COLLAPSED_SHARE:
        reason = (
            f"{100 * collapsed:.3g} % of the time fewer than {100 * DISTINCT_SHARE:.0f} % of the particles of "
            f"{estimator} differ, as the readings are too sharp for so few"
        )
    found = found[found > 0]
    several = float(np.mean(found > 1)) if found.size else np.nan
    most = int(found.max(initial=0))
    return Peaks(estimator, reason, found.size, several, most, folds[0].recoveries(), over, collapsed)


def _confirmed(found: list[Peak], points: np.ndarray, circular: np.ndarray) -> int:
    """Return the number of peaks of a cloud that are separate in another cloud with points (n, nx), too; at least one.

    Between peaks that are separate by chance, the other cloud has points.
    """
    kept: list[Peak] = []
    for peak in found:
        if all(_apart(peak, one, points, circular) for one in kept):
            kept.append(peak)
    return max(1, len(kept))


def _apart(one: Peak, other: Peak, points: np.ndarray, circular: np.ndarray) -> bool:
    spread = np.sqrt(np.maximum(np.diag(one.cov), np.diag(other.cov)))
    middle = one.mean + 0.5 * wrapped(other.mean - one.mean, circular)

    def share(centre: np.ndarray) -> float:
        return float(np.mean(np.all(np.abs(wrapped(points - centre, circular)) <= NEAR_SIGMA * spread, axis=1)))

    ends = min(share(one.mean), share(other.mean))
    return ends >= MIN_PEAK_WEIGHT and share(middle) < PEAK_DIP * ends


def tails(model: StateSpaceModel, log: Log, track: Track, *, marginal: bool) -> tuple[Tail, ...]:
    """Return the tails of every sensor row with used or rejected measurements; `marginal` as in calibration.py."""
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
                far = float(np.mean(np.abs(z) > FAR_SIGMA * np.sqrt(variance)))
                name = model.row_names[model.row_start[s] + k]
                found.append(Tail(name, int(e.size), kurtosis, far, jarque_bera(e).p_value))
    return tuple(found)
