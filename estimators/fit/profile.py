"""Profile likelihood: the interval of an entry where the hill is no parabola.

    2 (l(θ̂) - max over all others of l(θ_i = t)) = z²

has one solution on either side, or none where the data cannot tell the entry from none at all; then the interval ends
at the range. The signed root of the left side is nearly linear in t, so a few steps by the secant find it.

Source: Venzon & Moolgavkar (1988), doi:10.2307/2347496.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from .laplace import Curvature
from .objective import Objective

Z = 1.959963984540054
"""Of a 95 % interval."""

POOR = 0.2
"""Share by which the drop at the end of an interval may miss that of a parabola, in its root."""

LOOSE = 0.1
"""Share of the weak belief's deviation, from which on an entry is told so badly that the hill may be no parabola. The
others lie where it is one, or where only the gate makes it rough."""

SECANTS = 3
"""Points at which a profile is computed on one side, at most."""

CLOSE = 0.05
"""Share by which the root may miss at the end of an interval."""

STEPS = 5
"""Steps of the optimiser over the other entries; twice as many gradients at most."""

GRADIENT = 0.2
"""Gradient in deviations at which they are at their maximum: half its square is what is left, in nats."""


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
    lines = shape.cov / np.diag(shape.cov)[:, None]
    points = [np.clip(x + (found[i, side] - x[i]) * lines[i], low, high) for i, side in ends]
    dropped = [value - terms.sum() + objective.penalty(p) for p, terms in zip(points, objective.all_terms(points))]
    profiled = np.zeros(x.size, bool)
    loose = deviation > LOOSE * np.array([item.deviation for item in objective.entries])
    for i, side in ends:
        root = np.sqrt(max(0.0, 2.0 * dropped[2 * i + side])) / shape.widened[i]
        if abs(root - Z) > POOR * Z or not low[i] < found[i, side] < high[i]:
            profiled[i] = loose[i]
    H = np.linalg.inv(shape.cov)
    for i in np.flatnonzero(profiled).tolist():
        for side in (0, 1):
            found[i, side] = _end(objective, x, value, shape, H, i, found[i, side])
    return np.clip(found, low[:, None], high[:, None]), profiled


def _end(objective: Objective, x: np.ndarray, value: float, shape: Curvature, H: np.ndarray, i: int, t: float) -> float:
    """Where the profile of entry i has dropped, on the side of t."""
    low, high = objective.limits[i]
    t = float(np.clip(t, low, high))
    before, root_before = float(x[i]), 0.0
    for _ in range(SECANTS):
        if t == x[i]:
            break
        drop = value - _profile(objective, x, H, i, t)
        root = np.sqrt(max(0.0, 2.0 * drop)) / shape.widened[i]
        if abs(root - Z) < CLOSE * Z or (root < Z and t in (low, high)):
            break
        slope = (root - root_before) / (t - before)
        # Where it is flat, or rises again: further off.
        after = t + (Z - root) / slope if slope * (t - x[i]) > 0.0 else np.inf * (t - x[i])
        ratio = float(np.clip((after - x[i]) / (t - x[i]), 0.2, 3.0))
        before, root_before, t = t, root, float(np.clip(x[i] + ratio * (t - x[i]), low, high))
    return t


def _profile(objective: Objective, x: np.ndarray, H: np.ndarray, i: int, t: float) -> float:
    """The most that is reached with entry i at t; the others go by coordinates in which the parabola is a ball."""
    low, high = np.delete(np.array(objective.limits), i, axis=0).T
    others = np.delete(np.arange(x.size), i)
    rest = objective.pinned([i], np.where(np.arange(x.size) == i, t, x))
    belief = 0.5 * float(objective.precision[i] * (t - objective.start[i]) ** 2)
    if not others.size:
        return rest.value(np.zeros(0)) - belief
    across = H[np.ix_(others, others)]
    start = x[others] - np.linalg.solve(across, H[others, i]) * (t - x[i])
    root = np.linalg.inv(np.linalg.cholesky(across)).T

    def down(z: np.ndarray) -> tuple[float, np.ndarray]:
        found, gradient = rest.gradient(np.clip(start + root @ z, low, high))
        return -found, -root.T @ gradient

    found = minimize(
        down,
        np.zeros(others.size),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": STEPS, "maxfun": 2 * STEPS, "gtol": GRADIENT},
    )
    return -float(found.fun) - belief
