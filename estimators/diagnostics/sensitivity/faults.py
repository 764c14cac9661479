"""Faults as large as can pass unseen, folded at their size: a derivative does not know that a resistance doubles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .responses import Response, Start, moved, nudged, refold
from .visibility import Witness

NEAR = 0.05
"""Share by which a fault may miss the size that is seen, to be scaled to it."""

TRIES = 6

WIDEST = 4.0
"""Factor by which a size may change from one try to the next."""


class Fault(NamedTuple):
    """What one nudge can hide, in its unit.

    From `low` (zero or less) to `high` it passes unseen, within its range. `visible` is the size of the smallest fault
    of either sign that is seen, infinite if none in the range is. error (N, shown): the largest |x(fault) - x| at `low`
    and `high`. `nonlinearity`: the share by which the first size tried is further from being seen, or nearer, than the
    derivative says.
    """

    low: float
    high: float
    visible: float
    error: np.ndarray
    nonlinearity: float


def fault(begun: Start, response: Response, tests: Witness) -> Fault:
    """The faults of a nudge that the tests do not see, both ways."""
    nudge = response.nudge
    size = tests.multiple(response.whitened, response.innovation / begun.track.innovation_std)
    if not np.isfinite(size):
        # Nothing shows in any reading; what moves all the same is wrong without limit, or up to the range's end.
        moves = np.abs(response.states)
        error = np.multiply(moves, nudge.largest, out=np.zeros_like(moves), where=moves > 0.0)
        return Fault(nudge.low, nudge.high, np.inf, error, 0.0)
    low = _search(begun, response, tests, size, -1.0)
    high = _search(begun, response, tests, size, 1.0)
    error = np.maximum(low.error, high.error)
    return Fault(-low.size, high.size, min(low.shown, high.shown), error, max(low.nonlinearity, high.nonlinearity))


class _Side(NamedTuple):
    """The largest size that is hidden, the smallest that is seen, |x(fault) - x| (N, shown) and nonlinearity."""

    size: float
    shown: float
    error: np.ndarray
    nonlinearity: float


def _search(begun: Start, response: Response, tests: Witness, linear: float, sign: float) -> _Side:
    """The size that is just seen: scaled by the multiple that would be, and between seen and unseen by halving."""
    nudge = response.nudge
    limit = nudge.high if sign > 0.0 else -nudge.low
    if limit <= 0.0:
        return _Side(0.0, np.inf, np.zeros_like(response.states), 0.0)
    size = min(linear, limit)
    nonlinearity, hidden, shown = 0.0, None, np.inf
    for k in range(TRIES):
        innovation, whitened, states = moved(begun, refold(begun.estimator, nudged(begun.given, nudge, sign * size)))
        # What is no number is seen by anyone.
        finite = bool(np.all(np.isfinite(states)))
        multiple = tests.multiple(whitened, innovation / begun.track.innovation_std) if finite else 0.0
        if k == 0:
            nonlinearity = abs(multiple * size / linear - 1.0)
        if abs(multiple - 1.0) <= NEAR:
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
            size = min(limit, size * float(np.clip(multiple, 1.0 / WIDEST, WIDEST)))
    # No size was near enough: it jumps, or hardly grows. What was tried without being seen is known to be hidden.
    if hidden is None:
        return _Side(0.0, shown, np.zeros_like(response.states), nonlinearity)
    return hidden._replace(shown=shown)
