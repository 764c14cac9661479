"""How sure the data are of a fit: intervals and correlations from the curvature of what was maximised.

Near the maximum the penalised likelihood is that of a Gaussian with the covariance H⁻¹, H minus its second derivatives
(Laplace). They are taken by differences over about one deviation, so they are of the hill as wide as the interval, not
of its top, and neither the gate nor draws by chance disturb them. H⁻¹ is right if the model is. Of a real asset
innovations are correlated, the likelihood counts what it knows too often, and the covariance is H⁻¹ J H⁻¹ with J that
of the score, from sums over batches of time. Both are computed, and the wider is believed.

Sources: Abramowitz & Stegun (1964), 25.3.27, for the differences; White (1982), doi:10.2307/1912526, for H⁻¹ J H⁻¹.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from .objective import Objective

BATCHES = 40
"""Batches of time whose scores are summed up."""

LEAST = 1e-8
"""Share of the largest eigenvalue of H in units of its diagonal, below which there is no curvature."""


class Curvature(NamedTuple):
    """What the shape of the maximum says.

    cov (k, k) is H⁻¹ on the scales of the fit; `widened` (k,) by how much deviations are larger, since the readings'
    scores are correlated, at least 1; scores (k, n) are those of the events.
    """

    cov: np.ndarray
    widened: np.ndarray
    scores: np.ndarray

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviation of every entry (k,)."""
        found: np.ndarray = np.sqrt(np.diag(self.cov)) * self.widened
        return found

    @property
    def correlation(self) -> np.ndarray:
        """Of the estimates (k, k)."""
        root = np.sqrt(np.diag(self.cov))
        found: np.ndarray = self.cov / np.outer(root, root)
        return found


def curvature(objective: Objective, x: np.ndarray) -> Curvature:
    """Curvature at a maximum x (k,)."""
    k = x.size
    _, scores = objective.slopes(x)
    precision = objective.precision
    outer = scores @ scores.T + np.diag(precision)
    low, high = np.array(objective.limits).T
    # Inside the range on both sides; a maximum at its edge has differences towards the inside around a point there.
    steps = np.minimum(1.0 / np.sqrt(np.diag(outer)), (high - low) / 4.0)
    centre = np.clip(x, low + steps, high - steps)
    pairs = [(i, j) for i in range(k) for j in range(i)]
    unit = np.diag(steps)
    points = [centre]
    points += [centre + sign * unit[i] for i in range(k) for sign in (1.0, -1.0)]
    points += [centre + sign * (unit[i] + unit[j]) for i, j in pairs for sign in (1.0, -1.0)]
    values = np.array([terms.sum() for terms in objective.all_terms(points)])
    middle, single, double = values[0], values[1 : 1 + 2 * k].reshape(k, 2), values[1 + 2 * k :].reshape(-1, 2)
    H = np.diag((2.0 * middle - single.sum(axis=1)) / steps**2)
    for (i, j), both in zip(pairs, double, strict=True):
        mixed = both.sum() - single[i].sum() - single[j].sum() + 2.0 * middle
        H[i, j] = H[j, i] = -mixed / (2.0 * steps[i] * steps[j])
    H += np.diag(precision)
    cov = _inverse(H)
    if cov is None:
        # No hill at this width: the outer product is one in any case.
        cov = np.linalg.inv(outer)
    return Curvature(cov, _widened(cov, scores, precision), scores)


def _inverse(H: np.ndarray) -> np.ndarray | None:
    """Inverse of a positive definite matrix; None of another."""
    if not np.all(np.isfinite(H)) or np.any(np.diag(H) <= 0.0):
        return None
    root = np.sqrt(np.diag(H))
    values, vectors = np.linalg.eigh(H / np.outer(root, root))
    if values[0] <= LEAST * values[-1]:
        return None
    found: np.ndarray = (vectors / values) @ vectors.T / np.outer(root, root)
    return found


def _widened(cov: np.ndarray, scores: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """By how much H⁻¹ J H⁻¹ is wider than H⁻¹, (k,)."""
    told = np.flatnonzero(np.any(scores != 0.0, axis=0))
    if told.size < 2 * BATCHES:
        return np.ones(len(cov))
    edges = np.linspace(0, told.size, BATCHES, endpoint=False).astype(int)
    sums = np.add.reduceat(scores[:, told], edges, axis=1)
    sums -= sums.mean(axis=1, keepdims=True)
    J = sums @ sums.T * BATCHES / (BATCHES - 1.0) + np.diag(precision)
    robust = cov @ J @ cov
    found: np.ndarray = np.sqrt(np.maximum(1.0, np.diag(robust) / np.diag(cov)))
    return found


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
