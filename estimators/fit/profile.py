"""Profile likelihood: the interval of an entry where the hill is no parabola.

    2 (l(θ̂) - max over all others of l(θ_i = t)) = z²

has one solution on either side, or none where the data cannot tell the entry from none at all; then the interval ends
at the range. The signed root of the left side is nearly linear in t, so a few steps by the secant find it.

Source: Venzon & Moolgavkar (1988), doi:10.2307/2347496.
"""

from __future__ import annotations

import numpy as np

from .laplace import Curvature
from .objective import Objective
from .optimise import maximise

Z = 1.959963984540054
"""Of a 95 % interval."""

POOR = 0.2
"""Share by which the drop at the end of an interval may miss that of a parabola, in its root."""

SECANTS = 4
CLOSE = 0.05


def intervals(objective: Objective, x: np.ndarray, value: float, shape: Curvature) -> tuple[np.ndarray, np.ndarray]:
    """95 % intervals (k, 2) on the scales of the fit, and which of them are by profile (k,).

    Args:
        objective: What was maximised.
        x: Where, (k,).
        value: What it is there.
        shape: Its curvature there.
    """
    low, high = np.array(objective.limits).T
    deviation = shape.deviation
    found = np.stack([x - Z * deviation, x + Z * deviation], axis=1)
    ends = [(i, side) for i in range(x.size) for side in (0, 1)]
    # Where all others follow entry i: along this line the parabola drops as its profile.
    lines = shape.cov / np.diag(shape.cov)
    points = [np.clip(x + (found[i, side] - x[i]) * lines[i], low, high) for i, side in ends]
    dropped = [value - terms.sum() + objective.penalty(p) for p, terms in zip(points, objective.all_terms(points))]
    profiled = np.zeros(x.size, bool)
    for i, side in ends:
        root = np.sqrt(max(0.0, 2.0 * dropped[2 * i + side])) / shape.widened[i]
        if abs(root - Z) > POOR * Z or not low[i] < found[i, side] < high[i]:
            profiled[i] = True
    for i in np.flatnonzero(profiled).tolist():
        for side in (0, 1):
            found[i, side] = _end(objective, x, value, shape, i, found[i, side])
    return np.clip(found, low[:, None], high[:, None]), profiled


def _end(objective: Objective, x: np.ndarray, value: float, shape: Curvature, i: int, t: float) -> float:
    """Where the profile of entry i has dropped, on the side of t."""
    low, high = objective.limits[i]
    line = shape.cov[i] / shape.cov[i, i]
    t = float(np.clip(t, low, high))
    before, root_before = float(x[i]), 0.0
    for _ in range(SECANTS):
        root = np.sqrt(max(0.0, 2.0 * (value - _profile(objective, x, i, t, line)))) / shape.widened[i]
        if abs(root - Z) < CLOSE * Z or (root < Z and t in (low, high)):
            break
        slope = (root - root_before) / (t - before) if t != before else 0.0
        if slope * np.sign(t - x[i]) <= 0.0:
            # It rises again, or is flat: twice as far.
            after = x[i] + 2.0 * (t - x[i])
        else:
            after = t + (Z - root) / slope
            after = x[i] + np.clip((after - x[i]) / (t - x[i]), 0.2, 4.0) * (t - x[i])
        before, root_before, t = t, root, float(np.clip(after, low, high))
    return t


def _profile(objective: Objective, x: np.ndarray, i: int, t: float, line: np.ndarray) -> float:
    """The most that is reached with entry i at t."""
    low, high = np.array(objective.limits).T
    start = np.clip(x + (t - x[i]) * line, low, high)
    if x.size == 1:
        return objective.value(start)
    _, best = maximise(objective.pinned([i], start), np.delete(start, i), rounds=1)
    return best - 0.5 * float(objective.precision[i] * (t - objective.start[i]) ** 2)
