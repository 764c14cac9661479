"""How large the innovations are against what the filter says, and what the noise of the sensors would have to be.

A refused reading counts as one at the gate: as it is, one spike would speak for all; without it, the gate would hide
what it refuses. So squares are min(e², g), and their mean is divided by what it is in a consistent filter,

    E min(χ²_m, g) = m Pr(χ²_{m+2} ≤ g) + g Pr(χ²_m > g).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtr, chdtrc

from ..log import READING, Events
from ..numerics.quantiles import chi_square_quantile
from ..track import GATED, USED, Track
from ..tuning import Tuning
from .intervals import correlation_interval
from .whiteness import ljung_box

FEWEST = 50
"""Readings of a row from which on its noise is estimated."""


class SensorNoise(NamedTuple):
    """Variance of the noise of one sensor row as its innovations have it, in the square of the row's unit.

    `variance` is not positive where the innovations are smaller than the process noise and the model alone explain;
    `std` is its standard deviation, were the innovations white and normal, `n` how many there are. `correlation` is
    that of each with the next, and `chance` that of innovations as correlated as these in a filter that is right (a
    Ljung-Box test): where it is small, the innovations are no noise, and the variance of none.
    """

    variance: float
    std: float
    n: int
    correlation: float = 0.0
    chance: float = 1.0


def mean_nis(track: Track, gate: float | None) -> float:
    """Mean NIS a degree of freedom of the readings used and refused, 1 if the filter is consistent; NaN without any.

    Args:
        track: What was concluded.
        gate: That of the tuning; None where nothing is refused.
    """
    judged = (track.verdict == USED) | (track.verdict == GATED)
    nis, dof = track.nis[judged], track.dof[judged]
    m, g = _gates(gate, dof)
    expected = _expected(g, m)[dof].sum()
    return float(np.minimum(nis, g[dof]).sum() / expected) if expected > 0.0 else np.nan


def sensor_noise(track: Track, events: Events, tuning: Tuning) -> dict[str, SensorNoise]:
    """Noise of the sensor rows with enough readings, as their innovations ν have it.

    R̂ = mean ν² - (S - R), the innovations' covariance less what of it the filter lays to its own prediction, H P⁻ Hᵀ.
    Each reading counts by 1 / S², the inverse of the variance of ν²: where S is settled, as in the source, all count
    alike, and the first ones, predicted from a wide prior, do not spoil it. All that the innovations have too much or
    too little is laid to R, so it means something only where they are white: with a Q too small it is too large, and
    an error that lasts, of the model or of the sensor, is taken for one that the next reading averages away. P⁻
    follows from R; taken again and again the estimate comes to rest.

    Args:
        track: What was concluded, under `tuning`.
        events: Of what.
        tuning: Its R held as it is: nothing brought variances, and the filter adapted none.

    Source: Mohamed & Schwarz (1999), doi:10.1007/s001900050236, the R of the innovation-based filter; after Mehra
    (1970), doi:10.1109/TAC.1970.1099422.
    """
    model, found = tuning.model, dict[str, SensorNoise]()
    judged = (events.kind == READING) & ((track.verdict == USED) | (track.verdict == GATED))
    for s, sensor in enumerate(model.sensors):
        rows = np.flatnonzero(judged & (events.channel == s))
        dof = track.dof[rows]
        _, g = _gates(tuning.gate, dof)
        expected = _expected(g, np.ones(len(g)))
        for k in range(len(sensor.rows)):
            nu, S = track.innovation[rows, k], track.innovation_std[rows, k] ** 2
            known = np.isfinite(nu) & np.isfinite(S) & (S > 0.0)
            n = int(known.sum())
            if n < FEWEST:
                continue
            nu, S, m = nu[known], S[known], dof[known]
            R = float(tuning.r[model.row_start[s] + k])
            square = np.minimum(nu**2, g[m] * S) / expected[m]
            weight = S**-2
            excess = float(np.sum(weight * (square - S)) / np.sum(weight))
            std = float(np.sqrt(2.0 / np.sum(weight)))
            e = np.where(known, track.innovation[rows, k], np.nan) / track.innovation_std[rows, k]
            limit = np.sqrt(g[dof])
            e = np.clip(e, -limit, limit)
            correlation, chance = correlation_interval(e[known]).value, ljung_box(e).p_value
            found[model.row_names[model.row_start[s] + k]] = SensorNoise(R + excess, std, n, correlation, chance)
    return found


def _gates(gate: float | None, dof: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every number of degrees of freedom up to the largest, and its gate: quantiles are dear, and few differ."""
    m = np.arange(1.0 + dof.max(initial=0))
    return m, np.full(m.size, np.inf) if gate is None else chi_square_quantile(gate, m)


def _expected(g: np.ndarray, m: np.ndarray) -> np.ndarray:
    """E min(χ²_m, g) of each; m where there is no gate."""
    finite = np.isfinite(g)
    limit = np.where(finite, g, 1.0)
    return np.where(finite, m * chdtr(m + 2.0, limit) + limit * chdtrc(m, limit), m)
