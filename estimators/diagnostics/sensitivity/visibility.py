"""How large a fault must be before a test sees it: the best test there could be, and the bank that watches the twin.

What a fault does to the innovations is known here row by row. Scaled by s, it is seen by the best test from

    s² Σ ΔνᵀS⁻¹Δν = λ,    √λ = z + √(z² + 2h)

on: their log likelihood ratio against no fault is N(λ/2, λ), and passes h with the probability whose quantile is z
(Basseville & Nikiforov 1993, Detection of Abrupt Changes, 4.2 and 7.2). That test knows what the fault looks like.

The bank (evidence/) knows shifts of 0.2 σ and more, scales and correlations; what shifts a row by less than 0.1 σ
lets all its sums fall, however long it lasts. Under a known shift m of a standard normal e, each sum's steps have the
mean and the variance that follow from its log likelihood ratio

    log Λ = a e² + b e e₋ + c e₋² + d e + f

and it is seen where the sum of the means passes h by z standard deviations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...log import READING, Log
from ...model.state_space import StateSpaceModel
from ...numerics.jit import jit
from ...numerics.quantiles import normal_quantile
from ...track import USED, Track
from ...tuning import Tuning
from ..evidence import FURTHEST, RATIOS, no_baseline, watched

HALVINGS = 10
"""Of the bracket of a multiple, a factor of two wide: to 0.1 %."""

WIDEST = 2.0**12
"""Multiple of what the best test sees, beyond which the bank sees nothing."""


class Witness(NamedTuple):
    """What watches the innovations of a fold.

    h (rows,) are thresholds by sensor row, z the quantile of the probability of detection; `used` (N,) marks the used
    readings; `places` and `columns` are the events and the row of the reading of each sensor row; baseline (rows, 3 +
    tests) as in evidence/.
    """

    h: np.ndarray
    z: float
    used: np.ndarray
    places: tuple[np.ndarray, ...]
    columns: tuple[int, ...]
    baseline: np.ndarray
    bank: bool

    @property
    def noncentrality(self) -> float:
        """λ from which on the best test sees a fault."""
        return noncentrality(float(self.h.max()), self.z)

    def best(self, whitened: np.ndarray) -> float:
        """The multiple of a change S^-1/2 Δν (N, ny) that the best test sees; infinite if nothing changes."""
        size = float(np.sqrt(np.nansum(whitened[self.used] ** 2)))
        return float(np.sqrt(self.noncentrality)) / size if size > 0.0 else np.inf

    def multiple(self, whitened: np.ndarray, standardised: np.ndarray) -> float:
        """The multiple of a change that the tests see: of S^-1/2 Δν, for the bank also Δν over σ, both (N, ny)."""
        least = self.best(whitened)
        if not self.bank or not np.isfinite(least):
            return least
        rows = self._of_rows(standardised)
        low = high = least
        while not self._bank_sees(rows, high, self.z):
            low, high = high, 2.0 * high
            if high > WIDEST * least:
                return np.inf
        for _ in range(HALVINGS if high > low else 0):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self._bank_sees(rows, middle, self.z) else (middle, high)
        return high

    def sees(self, standardised: np.ndarray) -> tuple[bool, bool]:
        """Whether the bank sees a change, Δν over σ (N, ny), with the probability asked for, and with its complement.

        What it does not even see with the complement is invisible; between them chance decides.
        """
        rows = self._of_rows(standardised)
        return self._bank_sees(rows, 1.0, self.z), self._bank_sees(rows, 1.0, -self.z)

    def _of_rows(self, standardised: np.ndarray) -> list[np.ndarray]:
        """Shifts of each sensor row as the bank sees them, the correlation that was normal taken out."""
        rows = []
        for row, (place, k) in enumerate(zip(self.places, self.columns, strict=True)):
            m = np.nan_to_num(standardised[place, k]) / self.baseline[row, 1]
            phi = self.baseline[row, 2]
            before = np.concatenate([np.zeros(1), m[:-1]])
            rows.append((m - phi * before) / np.sqrt(1.0 - phi * phi))
        return rows

    def _bank_sees(self, rows: list[np.ndarray], size: float, z: float) -> bool:
        peaks = self.baseline[:, 3 : 3 + len(RATIOS)]
        return any(
            bool(passes(size * m, RATIOS, h, peak, z)) for m, h, peak in zip(rows, self.h, peaks, strict=True) if m.size
        )


def tests_of(
    model: StateSpaceModel,
    tuning: Tuning,
    log: Log,
    track: Track,
    *,
    every: float,
    detection: float,
    bank: bool,
) -> Witness:
    """The tests of a fold: thresholds as the bank's, log(readings between false alarms · tests) of each sensor."""
    watch = watched(model, tuning.gate, False, no_baseline(model) if tuning.baseline is None else tuning.baseline)
    t, kind, channel = log.t[: log.n], log.kind[: log.n], log.channel[: log.n]
    used = track.verdict == USED
    h, places, columns = [], [], []
    for s, sensor in enumerate(model.sensors):
        own = np.flatnonzero((kind == READING) & (channel == s))
        mine = own[used[own]]
        period = float(t[own[-1]] - t[own[0]]) * 1e-9 / (own.size - 1) if own.size > 1 else every
        for k in range(len(sensor.rows)):
            h.append(threshold(every / max(period, 1e-3), watch["n_tests"]))
            places.append(mine)
            columns.append(k)
    return Witness(
        np.array(h), normal_quantile(detection), used, tuple(places), tuple(columns), watch["baseline"], bank
    )


def threshold(readings: float, tests: int) -> float:
    """What a log likelihood ratio must reach, so that `tests` of them raise one false alarm in so many readings.

    h = log(readings · tests). A cumulated log likelihood ratio has a mean time of e^h at least between false alarms,
    whatever came before. Source: Lorden (1971), doi:10.1214/aoms/1177693055.
    """
    return float(np.log(max(8.0, readings) * tests))


def noncentrality(h: float, z: float) -> float:
    """λ of the smallest fault that the best test finds with the probability whose normal quantile is z."""
    return float((z + np.sqrt(z * z + 2.0 * h)) ** 2)


@jit
def passes(shifts, ratios, h, peaks, z):
    """Whether one of the bank's sums passes its threshold by z deviations where e is N(shift, 1), shifts (n,)."""
    for k in range(ratios.shape[0]):
        a, b, c, d, f = ratios[k, 0], ratios[k, 1], ratios[k, 2], ratios[k, 3], ratios[k, 4]
        limit = h + peaks[k]
        total = 0.0
        variance = 0.0
        old = 0.0
        for i in range(shifts.size):
            m = min(max(shifts[i], -FURTHEST), FURTHEST)
            if total <= 0.0:
                total = 0.0
                variance = 0.0
            step = a * (1.0 + m * m) + b * m * old + c * (1.0 + old * old) + d * m + f
            total += min(step, 0.5 * h)
            # What one e does to its own step and to the next may add up.
            slope = abs(2.0 * a * m + b * old + d) + abs(b * m + 2.0 * c * old)
            variance += slope * slope + 2.0 * (a * a + c * c) + b * b
            if total - z * np.sqrt(variance) >= limit:
                return True
            old = m
    return False
