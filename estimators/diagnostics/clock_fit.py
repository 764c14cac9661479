"""Offset and drift of a source's clock against the host's, from timestamps and arrivals of measurements.

arrival - t is the offset plus a delay that is never negative, so a line is fitted to the smallest delay of each segment
of time. Segments in which all measurements were delayed lie above the line by more than the others scatter, and are
left out.

Sources: Paxson (1998), doi:10.1145/277851.277865, for the minima of segments; Moon, Skelly & Towsley (1999),
doi:10.1109/INFCOM.1999.749287, for why the line must lie beneath all points. The smallest delay of the path cannot be
distinguished from an offset, and is part of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

SEGMENT_NS = 10**9
"""Initial length of a segment, of which the smallest delay is kept; doubled whenever `MAX_SEGMENTS` are full."""

MAX_SEGMENTS = 512

MIN_SEGMENTS = 8  # Stretches below which no drift is told
OUTLIER_DEVIATIONS = 10.0  # Robust deviations above the line beyond which a stretch was held up


class ClockFit(NamedTuple):
    """Offset and drift of t - arrival at present.

    offset: seconds by which the source's clock is ahead of the host's, minus the smallest delay. drift_ppm: change of
    the offset per second of the host, microseconds; NaN with too few segments. drift_error_ppm: half of its 95 %
    interval.
    """

    offset: float
    drift_ppm: float
    drift_error_ppm: float


class LeastDelays:
    """Smallest arrival - t of each segment, in bounded memory; independent of the division into batches."""

    def __init__(self) -> None:
        self._stretch = SEGMENT_NS
        self._at: list[int] = []
        self._arrival: list[int] = []
        self._delay: list[int] = []

    def note(self, t: np.ndarray, arrival: np.ndarray) -> None:
        """Add measurements with their times and arrivals, ns, each (n,)."""
        delay = arrival - t
        stretch = arrival // SEGMENT_NS
        # The first of the smallest delays of each segment in the batch.
        order = np.lexsort((arrival, delay, stretch))
        first = np.ones(order.size, np.bool_)
        first[1:] = np.diff(stretch[order]) != 0
        for i in order[first]:
            self._one(int(arrival[i]), int(delay[i]))

    def _one(self, arrival: int, delay: int) -> None:
        at = arrival // self._stretch
        if self._at and at < self._at[-1]:
            # The host's clock was set back: earlier delays are invalid.
            self._at, self._arrival, self._delay = [], [], []
        if self._at and self._at[-1] == at:
            if (delay, arrival) < (self._delay[-1], self._arrival[-1]):
                self._delay[-1], self._arrival[-1] = delay, arrival
            return
        self._at.append(at)
        self._arrival.append(arrival)
        self._delay.append(delay)
        if len(self._at) > MAX_SEGMENTS:
            self._stretch *= 2
            kept = list(zip(self._arrival, self._delay, strict=True))
            self._at, self._arrival, self._delay = [], [], []
            for earlier in kept:
                self._one(*earlier)

    def fit(self) -> ClockFit | None:
        """Return the line beneath the delays; None before the first measurement."""
        if not self._at:
            return None
        # Relative to the last, against rounding.
        x = np.array([arrival - self._arrival[-1] for arrival in self._arrival], float) * 1e-9
        y = np.array([delay - self._delay[-1] for delay in self._delay], float) * 1e-9
        last = self._delay[-1] * 1e-9
        if x.size < MIN_SEGMENTS:
            return ClockFit(-(last + float(y.min())), np.nan, np.nan)
        above = y - _robust_slope(x, y) * x
        middle = np.median(above)
        spread = 1.4826 * np.median(np.abs(above - middle))
        used = above <= middle + OUTLIER_DEVIATIONS * spread + 1e-9
        slope, level = np.polyfit(x[used], y[used], 1)
        rest = y[used] - (level + slope * x[used])
        lever = np.sum((x[used] - x[used].mean()) ** 2)
        error = np.sqrt(np.sum(rest**2) / (used.sum() - 2) / lever)
        return ClockFit(-(last + level + float(rest.min())), -1e6 * float(slope), 1.96e6 * float(error))


def _robust_slope(x: np.ndarray, y: np.ndarray) -> float:
    """Return the median of the slopes between all pairs of points, robust against a quarter of outliers.

    The smallest delays of groups of neighbours are used, so that a thousand pairs suffice. Source: Sen (1968),
    doi:10.1080/01621459.1968.10480934.
    """
    groups = np.array_split(np.arange(x.size), min(x.size, 48))
    least = np.array([group[np.argmin(y[group])] for group in groups])
    i, j = np.triu_indices(least.size, 1)
    return float(np.median((y[least[j]] - y[least[i]]) / (x[least[j]] - x[least[i]])))
