"""Is the state small enough for a covariance, or is an ensemble needed? Arithmetic."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...model.state_space import LARGE, StateSpaceModel

CLOSE = 0.1
"""Share by which the standard deviations of an ensemble may be off by chance."""

BUSY = 0.5
"""Share of one processor that an estimate may take: the rest is for late readings and for refolds."""


class Dimension(NamedTuple):
    """What a step costs, and what it would cost otherwise.

    `flops` are those of a covariance step of n states and m rows, 4 n³ for F P Fᵀ and 6 m n² for the update; `memory`
    is the covariance's, bytes. `share` of one processor is taken at `rate` readings a second by the filter in use, at
    `seconds` a reading. `largest` is the n at which a covariance would take all of the processor, if n³ were all.
    `members` is the ensemble whose σ is within 10 %: one of m members is off by 1 / √(2 (m - 1)). `passes`: `share` is
    not above a half, and no covariance is needed that cannot be formed.
    """

    nx: int
    rows: int
    flops: float
    memory: float
    rate: float
    seconds: float
    share: float
    largest: float
    members: int
    passes: bool


def dimension(model: StateSpaceModel, rate: float, seconds: float, *, covariance: bool) -> Dimension:
    """The arithmetic of one twin.

    Args:
        model: Whose states.
        rate: Readings a second.
        seconds: That the filter in use takes for each reading, with what comes between two, measured.
        covariance: Whether that filter carries one.
    """
    n = model.nx
    rows = max(len(sensor.rows) for sensor in model.sensors)
    share = rate * seconds
    members = int(np.ceil(1.0 + 0.5 / CLOSE**2))
    return Dimension(
        nx=n,
        rows=rows,
        flops=4.0 * n**3 + 6.0 * rows * n**2,
        memory=8.0 * n**2,
        rate=rate,
        seconds=seconds,
        share=share,
        largest=n * share ** (-1.0 / 3.0) if covariance and share > 0.0 else np.nan,
        members=members,
        passes=share <= BUSY and (n <= LARGE or not covariance),
    )


def spread_error(members: float) -> float:
    """Standard error of a standard deviation of so many normal members, as a share: 1 / √(2 (m - 1))."""
    return float(1.0 / np.sqrt(2.0 * (members - 1.0))) if members > 1.0 else np.inf
