"""Can the estimate be trusted: NIS against its chi-square bounds, and health."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types

from .jit import F1, I1, f64, i64, jit
from .quantiles import chi_square_quantile
from .track import DEGRADED, DIVERGED, GATED, STALE, TRACKING, USED, track_type

PROBABILITY = 0.95
"""Of the bounds that charts and reports show."""


class HealthPolicy(NamedTuple):
    """When a twin may be trusted.

    `window` readings are averaged. Without a reading for `degraded_after` seconds the twin is degraded, after
    `stale_after` stale. It is degraded when the windowed NIS exceeds what chance exceeds once in a thousand windows,
    and diverged when it is `diverged_nis` times what it should be, when the gate refuses more than `diverged_gated` of
    the window, or when a number is not finite.
    """

    window: int = 50
    degraded_after: float = 5.0
    stale_after: float = 30.0
    diverged_nis: float = 10.0
    diverged_gated: float = 0.5


class Bounds(NamedTuple):
    """Chi-square quantiles by degrees of freedom: the 95 % bounds, and the bound for `degraded`."""

    low: Any
    high: Any
    alarm: Any


bounds_type = types.NamedUniTuple(F1, len(Bounds._fields), Bounds)
policy_type = types.NamedTuple((i64, f64, f64, f64, f64), HealthPolicy)


def chi_square_bounds(most: int) -> Bounds:
    """Quantiles for 0 to `most` degrees of freedom."""
    dof = np.arange(most + 1)
    dof[0] = 1  # of no use, but chi-square has no quantile for 0
    tail = (1.0 - PROBABILITY) / 2.0
    return Bounds(chi_square_quantile(tail, dof), chi_square_quantile(1.0 - tail, dof), chi_square_quantile(0.999, dof))


def nis_bounds(dof: int, readings: int) -> tuple[float, float]:
    """95 % bounds of the mean NIS of `readings` readings with `dof` degrees of freedom in all.

    Source: Bar-Shalom, Li & Kirubarajan (2001), 5.4.2, equation 5.4.2-18.
    """
    tail = (1.0 - PROBABILITY) / 2.0
    return float(chi_square_quantile(tail, dof) / readings), float(chi_square_quantile(1.0 - tail, dof) / readings)


@jit
def assess(first, last, t, track, policy, bounds):
    """Fill windowed NIS, its bounds and health of rows `first` to `last` of a track.

    Each row looks back over the rows before it, so the outcome does not depend on how a fold was cut into pieces.
    """
    for i in range(first, last):
        total = 0.0
        dof = 0
        used = 0
        gated = 0
        row = i
        while row >= 0 and used + gated < policy.window and i - row < 5 * policy.window:
            verdict = track.verdict[row]
            if verdict == USED:
                total += track.nis[row]
                dof += track.dof[row]
                used += 1
            elif verdict == GATED:
                gated += 1
            row -= 1
        if i == 0 or track.verdict[i] == USED or track.verdict[i] == GATED:
            track.age[i] = 0.0
        else:
            track.age[i] = track.age[i - 1] + (t[i] - t[i - 1]) * 1e-9
        finite = True
        for j in range(track.mean.shape[1]):
            finite = finite and np.isfinite(track.mean[i, j]) and np.isfinite(track.std[i, j])
        health = TRACKING
        if used > 0:
            track.nis_mean[i] = total / used
            track.nis_low[i] = bounds.low[dof] / used
            track.nis_high[i] = bounds.high[dof] / used
        else:
            track.nis_mean[i] = np.nan
            track.nis_low[i] = np.nan
            track.nis_high[i] = np.nan
        if not finite:
            health = DIVERGED
        elif track.age[i] > policy.stale_after:
            health = STALE
        elif used + gated >= 10 and (
            gated > policy.diverged_gated * (used + gated) or total > policy.diverged_nis * dof
        ):
            health = DIVERGED
        elif track.age[i] > policy.degraded_after:
            health = DEGRADED
        elif used >= 10 and total > bounds.alarm[dof]:
            health = DEGRADED
        track.health[i] = health


assess_signature = types.void(i64, i64, I1, track_type, policy_type, bounds_type)
