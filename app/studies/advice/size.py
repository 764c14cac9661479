"""Is the state small enough for a covariance at the asset's rate, or is an ensemble required?"""

from __future__ import annotations

from estimators.model.state_space import LARGE

from .claim import NO, YES, Claim
from .measured import Measured
from .words import bytes_text, digits

SPEED = 1e9
"""Multiplications and additions a second of one processor in small dense matrices, of the order of magnitude."""

SHARE = 0.5
"""Of one processor that an estimate may take; the rest is for late readings and refolds."""


def small(measured: Measured) -> Claim:
    """Whether 4 n³ + 6 m n² operations a reading, and 8 n² bytes, are affordable.

    4 n³ are those of F P Fᵀ, 6 m n² those of the update with m rows.
    """
    model, rate = measured.twin.model, measured.rate
    n, m = model.nx, max(len(sensor.rows) for sensor in model.sensors)
    flops = 4.0 * n**3 + 6.0 * m * n**2
    share = rate * flops / SPEED
    fits = n <= LARGE and share <= SHARE
    reason = (
        f"{_counted(n, 'state')}: a covariance takes {bytes_text(8.0 * n**2)} and 4 n³ + 6 m n² = {digits(flops)} "
        f"operations a reading of m = {_counted(m, 'row')}; at {digits(rate)} readings a second that is "
        f"{digits(100 * share)} % of a processor of {digits(SPEED)} operations a second"
    )
    if fits:
        figure, threshold, of = float(n), float(LARGE), "states"
    elif n > LARGE:
        figure, threshold, of = float(n), float(LARGE), "states"
        reason += f"; beyond {LARGE:,} states no filter here forms one"
    else:
        figure, threshold, of = share, SHARE, "of a processor for a covariance"
    question = "Is the state small enough for a covariance at this rate?"
    return Claim("size", question, YES if fits else NO, figure, threshold, of, reason)


def _counted(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' if number > 1 else ''}"
