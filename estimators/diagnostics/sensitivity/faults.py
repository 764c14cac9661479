"""Faults as large as can pass unseen, folded at their size: a derivative does not know that a resistance doubles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...track import USED
from .nudges import nudged
from .responses import Response, Start, moved, refold, whiten

NEAR = 0.05
"""Share of √λ within which a size is near enough to be scaled to the one that is sought."""

TRIES = 6

WIDEST = 4.0
"""Factor by which a size may change from one try to the next."""


class Fault(NamedTuple):
    """What one nudge can hide, in its unit.

    From `low` (zero or less) to `high` it passes unseen, within its range. `visible` is the size of the smallest fault
    of either sign that is seen, infinite if none in the range is. error (N, shown): the largest |x(fault) - x| at `low`
    and `high`. `nonlinearity`: the share by which √λ at the size that the derivative calls visible is another.
    """

    low: float
    high: float
    visible: float
    error: np.ndarray
    nonlinearity: float


def fault(begun: Start, response: Response, size: float, least: float) -> Fault:
    """The faults of a nudge with λ = Σ ΔνᵀS⁻¹Δν up to `least`, both ways; `size` is what the derivative says of it."""
    nudge = response.nudge
    if not np.isfinite(size):
        # Nothing shows in any reading; what moves all the same is wrong without limit, or up to the range's end.
        moves = np.abs(response.states)
        error = np.multiply(moves, nudge.largest, out=np.zeros_like(moves), where=moves > 0.0)
        return Fault(nudge.low, nudge.high, np.inf, error, 0.0)
    low = _search(begun, response, -1.0, min(size, -nudge.low), -nudge.low, least)
    high = _search(begun, response, 1.0, min(size, nudge.high), nudge.high, least)
    error = np.maximum(low.error, high.error)
    return Fault(-low.size, high.size, min(low.shown, high.shown), error, max(low.nonlinearity, high.nonlinearity))


class _Side(NamedTuple):
    """The largest size that is hidden, the smallest that is seen, |x(fault) - x| (N, shown) and nonlinearity."""

    size: float
    shown: float
    error: np.ndarray
    nonlinearity: float


def _search(begun: Start, response: Response, sign: float, size: float, limit: float, least: float) -> _Side:
    """The size at which λ is `least`, by scaling it with √λ, and between what is seen and what is not by halving."""
    if limit <= 0.0:
        return _Side(0.0, np.inf, np.zeros_like(response.states), 0.0)
    used = begun.track.verdict == USED
    slope = float(np.sqrt(np.nansum(response.whitened[used] ** 2)))
    nonlinearity, hidden, shown = 0.0, None, np.inf
    for k in range(TRIES):
        innovation, states = moved(begun, refold(begun.estimator, nudged(begun.given, response.nudge, sign * size)))
        # What is no number is seen by anyone.
        finite = bool(np.all(np.isfinite(states)))
        root = float(np.sqrt(np.nansum(whiten(begun, innovation)[used] ** 2))) if finite else np.inf
        ratio = root / np.sqrt(least)
        if k == 0:
            nonlinearity = abs(root / (slope * size) - 1.0) if finite else np.inf
        if abs(ratio - 1.0) <= NEAR:
            return _Side(size / ratio, size / ratio, np.abs(states) / ratio, nonlinearity)
        if ratio > 1.0:
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
            size = min(limit, size * float(np.clip(1.0 / ratio, 1.0 / WIDEST, WIDEST)))
    # No size was near enough: it jumps, or hardly grows. What was tried without being seen is known to be hidden.
    if hidden is None:
        return _Side(0.0, shown, np.zeros_like(response.states), nonlinearity)
    return hidden._replace(shown=shown)
