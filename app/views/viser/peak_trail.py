"""Where an estimate went whose cloud has several peaks at times: at the mean between them it never was.

The track knows the mean alone. So where the scene saw several peaks, the way is that of the heaviest; between two looks
at which there were several, rows of the mean are left out.
"""

from __future__ import annotations

import numpy as np

MOST = 4096
"""Looks that are remembered."""


class PeakTrail:
    """The looks of one scene, each with its time, the mean in its row, and the heaviest of several peaks, or NaN."""

    def __init__(self) -> None:
        self._looks: list[tuple[int, np.ndarray, np.ndarray]] = []

    def look(self, t: np.ndarray, mean: np.ndarray, peak: np.ndarray | None) -> None:
        """Remember what is seen with the newest row.

        Args:
            t: Times of the rows, ns, (n,).
            mean: The place that the mean of each gives, (n, 2).
            peak: Place of the heaviest peak where there are several, (2,); None where there is one.
        """
        if self._looks:
            then, place, _ = self._looks[-1]
            row = min(int(np.searchsorted(t, then, side="right")) - 1, len(t) - 1)
            # Rows that are others by now, of another filter or after a late reading, had other peaks.
            if then > t[-1] or row >= 0 and t[row] == then and not np.array_equal(mean[row], place, equal_nan=True):
                self._looks.clear()
        seen = np.full(2, np.nan) if peak is None else np.array(peak, float)
        if self._looks and self._looks[-1][0] == t[-1]:
            self._looks.pop()
        self._looks = [*self._looks[-MOST + 1 :], (int(t[-1]), mean[-1].copy(), seen)]

    def of(self, t: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """The way, (m, 2): the mean's, and where there were several peaks that of the heaviest."""
        if not self._looks or not any(np.isfinite(peak[0]) for *_, peak in self._looks):
            return mean
        looks = np.array([then for then, *_ in self._looks])
        peaks = np.array([peak for *_, peak in self._looks])
        several = np.isfinite(peaks[:, 0])
        # The look that a row led up to; those after the last, of which nothing was seen yet, are as that was.
        led = np.minimum(np.searchsorted(looks, t), len(looks) - 1)
        kept = ~several[led]
        peaked = several & (looks >= t[0])
        times = np.concatenate((t[kept], looks[peaked]))
        return np.concatenate((mean[kept], peaks[peaked]))[np.argsort(times, kind="stable")]
