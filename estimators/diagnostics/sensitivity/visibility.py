"""Minimal detectable faults: for the optimal test of a known fault, and for the detectors that watch the twin.

The effect of a fault on the innovations is known row by row. Scaled by s, the optimal test detects it from

    s² Σ ΔνᵀS⁻¹Δν = λ,    √λ = z + √(z² + 2h)

on: their log likelihood ratio against no fault is N(λ/2, λ), and passes h with the probability whose quantile is z
(Basseville & Nikiforov 1993, Detection of Abrupt Changes, 4.2 and 7.2). That test knows the shape of the fault.

The detectors (`detectors.py`) test shifts of 0.2 σ and more, scales and correlations; a shift of less than 0.1 σ lowers
all their sums, however long it lasts. Under a known shift m of a standard normal e, the steps of each sum have the mean
and the variance that follow from its log-likelihood ratio

    log Λ = a e² + b e e₋ + c e₋² + d e + f

and the fault is detected where the sum of the means exceeds h by z standard deviations.

Faults are folded at their actual size, since a derivative does not describe a resistance that doubles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...log import Log
from ...model.state_space import StateSpaceModel
from ...numerics.jit import jit
from ...numerics.quantiles import normal_quantile
from ...track import USED, Track
from ...tuning import Tuning
from ..detector_state import detector_context, no_baseline
from ..detectors import MAX_SIGMA, RATIOS
from .responses import Nudge, Response, Start

BISECTIONS = 10  # Bisections of the bracket of a multiple, a factor of two wide: to 0.1 %
MAX_MULTIPLE = 2.0**12  # Multiple of the optimal test's minimal fault beyond which the detectors detect nothing


class FaultTests(NamedTuple):
    """Tests on the innovations of a fold.

    h (rows,): thresholds by sensor row; z: quantile of the probability of detection; used (N,): the used measurements;
    places, columns: events and row of the measurement of each sensor row; baseline (rows, 3 + tests); bank: whether the
    twin's detectors count, or the optimal test.
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
        """λ from which the optimal test detects a fault."""
        return noncentrality(float(self.h.max()), self.z)

    def optimal_multiple(self, whitened: np.ndarray) -> float:
        """Return the multiple of S^-1/2 Δν (N, ny) that the optimal test detects; infinite if nothing changes.

        It is 0 if the change is beyond what a float64 can hold, as of a fold that has diverged.
        """
        with np.errstate(over="ignore"):
            size = float(np.sqrt(np.nansum(whitened[self.used] ** 2)))
        return float(np.sqrt(self.noncentrality)) / size if size > 0.0 else np.inf

    def multiple(self, whitened: np.ndarray, standardised: np.ndarray) -> float:
        """Return the detectable multiple of a change S^-1/2 Δν and, for the detectors, Δν over σ, both (N, ny)."""
        least = self.optimal_multiple(whitened)
        if not self.bank or not 0.0 < least < np.inf:
            return least
        rows = self._of_rows(standardised)
        low = high = least
        while not self._detected(rows, high, self.z):
            low, high = high, 2.0 * high
            if high > MAX_MULTIPLE * least:
                return np.inf
        for _ in range(BISECTIONS if high > low else 0):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self._detected(rows, middle, self.z) else (middle, high)
        return high

    def detects(self, standardised: np.ndarray) -> tuple[bool, bool]:
        """Return whether the detectors detect a change Δν over σ (N, ny) with probability p, and with 1 - p.

        A change that is not even detected with 1 - p is undetectable; in between, chance decides.
        """
        rows = self._of_rows(standardised)
        return self._detected(rows, 1.0, self.z), self._detected(rows, 1.0, -self.z)

    def _of_rows(self, standardised: np.ndarray) -> list[np.ndarray]:
        """Return the shift of e of each sensor row, less the correlation of the baseline."""
        rows = []
        for row, (place, k) in enumerate(zip(self.places, self.columns, strict=True)):
            m = np.nan_to_num(standardised[place, k]) / self.baseline[row, 1]
            phi = self.baseline[row, 2]
            before = np.concatenate([np.zeros(1), m[:-1]])
            rows.append((m - phi * before) / np.sqrt(1.0 - phi * phi))
        return rows

    def _detected(self, rows: list[np.ndarray], size: float, z: float) -> bool:
        peaks = self.baseline[:, 3 : 3 + len(RATIOS)]
        return any(
            bool(exceeds(size * m, RATIOS, h, peak, z))
            for m, h, peak in zip(rows, self.h, peaks, strict=True)
            if m.size
        )


def fault_tests(
    model: StateSpaceModel,
    tuning: Tuning,
    log: Log,
    track: Track,
    *,
    every: float,
    detection: float,
    bank: bool,
) -> FaultTests:
    """Return the tests of a fold with the detectors' thresholds, log(measurements between false alarms · tests)."""
    watch = detector_context(
        model, tuning.gate, False, no_baseline(model) if tuning.baseline is None else tuning.baseline
    )
    used = track.verdict == USED
    h, places, columns = [], [], []
    for s, sensor in enumerate(model.sensors):
        own = log.events.of_sensor(s)
        mine = own[used[own]]
        period = float(log.t[own[-1]] - log.t[own[0]]) * 1e-9 / (own.size - 1) if own.size > 1 else every
        for k in range(len(sensor.rows)):
            h.append(threshold(every / max(period, 1e-3), watch["n_tests"]))
            places.append(mine)
            columns.append(k)
    return FaultTests(
        np.array(h), normal_quantile(detection), used, tuple(places), tuple(columns), watch["baseline"], bank
    )


def threshold(readings: float, tests: int) -> float:
    """Return the threshold at which `tests` log-likelihood ratios raise one false alarm in so many measurements.

    h = log(readings · tests). An accumulated log-likelihood ratio has a mean time of at least e^h between false alarms,
    whatever came before. Source: Lorden (1971), doi:10.1214/aoms/1177693055.
    """
    return float(np.log(max(8.0, readings) * tests))


def noncentrality(h: float, z: float) -> float:
    """Return λ of the smallest fault that the optimal test detects with the probability of normal quantile z."""
    return float((z + np.sqrt(z * z + 2.0 * h)) ** 2)


@jit
def exceeds(shifts, ratios, h, peaks, z):
    """Return whether a detector exceeds its threshold by z standard deviations where e is N(shift, 1), shifts (n,)."""
    for k in range(ratios.shape[0]):
        a, b, c, d, f = ratios[k, 0], ratios[k, 1], ratios[k, 2], ratios[k, 3], ratios[k, 4]
        limit = h + peaks[k]
        total = 0.0
        variance = 0.0
        old = 0.0
        for i in range(shifts.size):
            m = min(max(shifts[i], -MAX_SIGMA), MAX_SIGMA)
            if total <= 0.0:
                total = 0.0
                variance = 0.0
            step = a * (1.0 + m * m) + b * m * old + c * (1.0 + old * old) + d * m + f
            total += min(step, 0.5 * h)
            # The effects of one e on its own step and on the next may add up.
            slope = abs(2.0 * a * m + b * old + d) + abs(b * m + 2.0 * c * old)
            variance += slope * slope + 2.0 * (a * a + c * c) + b * b
            if total - z * np.sqrt(variance) >= limit:
                return True
            old = m
    return False


SIZE_TOLERANCE = 0.05  # Relative distance to the detectable size within which a fault is scaled to it

MAX_REFOLDS = 6

MAX_SIZE_CHANGE = 4.0  # Factor by which a size may change from one refold to the next


class UndetectableFault(NamedTuple):
    """Undetectable sizes of one nudge, in its unit, and its response.

    low (zero or less) to high: undetectable, within the nudge's range. visible: size of the smallest detectable fault
    of either sign, infinite if none in the range is. error (N, shown): the largest |x(fault) - x| at low and high.
    nonlinearity: relative difference between the first size tried and that predicted by the derivative.
    """

    nudge: Nudge
    response: Response
    low: float
    high: float
    visible: float
    error: np.ndarray
    nonlinearity: float

    @property
    def range_text(self) -> str:
        """Range of undetectable sizes, in words."""
        return self.nudge.range_text(self.low, self.high)

    @property
    def text(self) -> str:
        """The fault with this range: `parameter magnet_ambient, -31 to +92 %`."""
        return f"{self.nudge.subject}, {self.range_text}"


def undetectable_fault(begun: Start, nudge: Nudge, response: Response, tests: FaultTests) -> UndetectableFault:
    """Return the undetectable faults of a nudge with this derivative, in both directions."""
    size = tests.multiple(response.whitened, response.innovation / begun.track.innovation_std)
    if not np.isfinite(size):
        # No innovation changes: a state that moves can be wrong without limit, or up to the end of the range.
        moves = np.abs(response.states)
        largest = max(abs(nudge.low), abs(nudge.high))
        error = np.multiply(moves, largest, out=np.zeros_like(moves), where=moves > 0.0)
        return UndetectableFault(nudge, response, nudge.low, nudge.high, np.inf, error, 0.0)
    low, high = (_search(begun, nudge, tests, size, sign) for sign in (-1.0, 1.0))
    return UndetectableFault(
        nudge=nudge,
        response=response,
        low=-low.size,
        high=high.size,
        visible=min(low.shown, high.shown),
        error=np.maximum(low.error, high.error),
        nonlinearity=max(low.nonlinearity, high.nonlinearity),
    )


class _Side(NamedTuple):
    """Largest undetectable and smallest detectable size, |x(fault) - x| (N, shown) and nonlinearity."""

    size: float
    shown: float
    error: np.ndarray
    nonlinearity: float


def _search(begun: Start, nudge: Nudge, tests: FaultTests, linear: float, sign: float) -> _Side:
    """Search the detectable size: scale by the detectable multiple, then bisect."""
    limit = nudge.high if sign > 0.0 else -nudge.low
    if limit <= 0.0:
        return _Side(0.0, np.inf, np.zeros_like(begun.track.mean), 0.0)
    size = min(linear, limit)
    nonlinearity, hidden, shown = 0.0, None, np.inf
    for k in range(MAX_REFOLDS):
        innovation, whitened, states = begun.moved(begun.with_fault(nudge, sign * size))
        # An estimate that is not finite is always detected.
        finite = bool(np.all(np.isfinite(states)))
        multiple = tests.multiple(whitened, innovation / begun.track.innovation_std) if finite else 0.0
        if k == 0:
            nonlinearity = abs(multiple * size / linear - 1.0)
        if abs(multiple - 1.0) <= SIZE_TOLERANCE:
            return _Side(size * multiple, size * multiple, np.abs(states) * multiple, nonlinearity)
        if multiple < 1.0:
            shown = min(shown, size)
        else:
            hidden = _Side(size, np.inf, np.abs(states), nonlinearity)
            if size >= limit:
                return hidden
        if hidden is not None and np.isfinite(shown):
            size = float(np.sqrt(hidden.size * shown))
        elif k == 1 and hidden is not None and np.isfinite(limit):
            size = limit
        else:
            size = min(limit, size * float(np.clip(multiple, 1.0 / MAX_SIZE_CHANGE, MAX_SIZE_CHANGE)))
    # No size was close enough: the response jumps, or hardly grows. The largest size tried undetected is a bound.
    if hidden is None:
        return _Side(0.0, shown, np.zeros_like(begun.track.mean), nonlinearity)
    return hidden._replace(shown=shown)
