"""Uncertainty of a fit: covariance by curvature, and intervals by profile likelihood where the curvature is not enough.

Near the maximum the penalised likelihood is that of a Gaussian with the covariance H⁻¹, H minus its second derivatives
(Laplace). They are taken by differences over about one deviation, so they describe the maximum over the width of the
interval, undisturbed by the gate or by random draws. H⁻¹ is right if the model is. Real innovations are correlated, so
the likelihood counts their information too often, and the covariance is H⁻¹ J H⁻¹ with J that of the score, from sums
over batches of time. The wider of the two is used.

The profile likelihood of entry i, 2 (l(θ̂) - max over all others of l(θ_i = t)) = z², has one solution on either side,
or none where the data do not identify the entry; then the interval ends at the range. The signed root of the left side
is nearly linear in t, so a few secant steps find it.

Sources: Abramowitz & Stegun (1964), 25.3.27, for the differences; White (1982), doi:10.2307/1912526, for H⁻¹ J H⁻¹;
Venzon & Moolgavkar (1988), doi:10.2307/2347496, for the profile.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .objective import Objective, quasi_newton

Z = 1.959963984540054  # Half-width of a 95 % interval, in deviations
SCORE_BATCHES = 40  # Batches of time whose scores are summed

MIN_CURVATURE = 1e-8
"""Share of the largest eigenvalue of H, in units of its diagonal, below which there is no curvature."""

MAX_MISFIT = 0.2  # Share by which the drop at the end of an interval may differ from that of a parabola, in its root

MIN_LOOSENESS = 0.1
"""Share of the weak prior's deviation above which an entry may need a profile. Below it, only the gate makes the
likelihood rough."""

MAX_SECANTS = 3  # Most points of a profile on one side
ROOT_TOLERANCE = 0.05  # Relative error of the root at the end of an interval
PROFILE_STEPS = 3  # Steps over the other entries, which start at the maximum of the parabola


class LikelihoodCurvature(NamedTuple):
    """Shape of a maximum.

    cov (k, k) is H⁻¹ on the scales of the fit; `widened` (k,) the factor, at least 1, by which correlated scores widen
    the deviations.
    """

    cov: np.ndarray
    widened: np.ndarray

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviation of every entry (k,)."""
        found: np.ndarray = np.sqrt(np.diag(self.cov)) * self.widened
        return found

    @property
    def correlation(self) -> np.ndarray:
        """Correlation of the estimates (k, k)."""
        root = np.sqrt(np.diag(self.cov))
        found: np.ndarray = self.cov / np.outer(root, root)
        return found

    @property
    def lines(self) -> np.ndarray:
        """Change of all entries per unit of each, (k, k), along which the parabola drops as its profile."""
        found: np.ndarray = self.cov / np.diag(self.cov)[:, None]
        return found


def curvature_points(k: int) -> int:
    """Return the number of points that the curvature of k entries takes."""
    return 2 + 3 * k + k * (k - 1)


def curvature(objective: Objective, x: np.ndarray) -> LikelihoodCurvature:
    """Return the curvature at a maximum x (k,)."""
    k = x.size
    _, scores = objective.slopes(x)
    precision = objective.precision
    outer = scores @ scores.T + np.diag(precision)
    if objective.progress.stop:
        rough: np.ndarray = np.linalg.inv(outer)
        return LikelihoodCurvature(rough, _widened(rough, scores, precision))
    low, high = np.array(objective.limits).T
    # The points stay within the range: at its edge they are about a point inside.
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
    cov = _inverse(H + np.diag(precision))
    if cov is None:
        # Without curvature at this width, the outer product is positive definite in any case.
        cov = np.linalg.inv(outer)
    return LikelihoodCurvature(cov, _widened(cov, scores, precision))


def _inverse(H: np.ndarray) -> np.ndarray | None:
    """Return the inverse of a positive definite matrix; None for any other."""
    if not np.all(np.isfinite(H)) or np.any(np.diag(H) <= 0.0):
        return None
    root = np.sqrt(np.diag(H))
    values, vectors = np.linalg.eigh(H / np.outer(root, root))
    if values[0] <= MIN_CURVATURE * values[-1]:
        return None
    found: np.ndarray = (vectors / values) @ vectors.T / np.outer(root, root)
    return found


def _widened(cov: np.ndarray, scores: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Return the factor by which deviations of H⁻¹ J H⁻¹ exceed those of H⁻¹, (k,)."""
    scored = np.flatnonzero(np.any(scores != 0.0, axis=0))
    if scored.size < 2 * SCORE_BATCHES:
        return np.ones(len(cov))
    edges = np.linspace(0, scored.size, SCORE_BATCHES, endpoint=False).astype(int)
    sums = np.add.reduceat(scores[:, scored], edges, axis=1)
    sums -= sums.mean(axis=1, keepdims=True)
    J = sums @ sums.T * SCORE_BATCHES / (SCORE_BATCHES - 1.0) + np.diag(precision)
    robust = cov @ J @ cov
    found: np.ndarray = np.sqrt(np.maximum(1.0, np.diag(robust) / np.diag(cov)))
    return found


def intervals(
    objective: Objective, x: np.ndarray, value: float, shape: LikelihoodCurvature
) -> tuple[np.ndarray, np.ndarray]:
    """Return 95 % intervals (k, 2) on the scales of the fit, and the mask of those by profile (k,).

    Args:
        objective: The objective.
        x: Its maximum, (k,).
        value: Its value there.
        shape: Its curvature there.
    """
    low, high = np.array(objective.limits).T
    deviation = shape.deviation
    found = np.stack([x - Z * deviation, x + Z * deviation], axis=1)
    ends = [(i, side) for i in range(x.size) for side in (0, 1)]
    points = [np.clip(x + (found[i, side] - x[i]) * shape.lines[i], low, high) for i, side in ends]
    dropped = [value - terms.sum() + objective.penalty(p) for p, terms in zip(points, objective.all_terms(points))]
    profiled = np.zeros(x.size, bool)
    loose = deviation > MIN_LOOSENESS * np.array([item.deviation for item in objective.entries])
    for i, side in ends:
        root = np.sqrt(max(0.0, 2.0 * dropped[2 * i + side])) / shape.widened[i]
        if abs(root - Z) > MAX_MISFIT * Z or not low[i] < found[i, side] < high[i]:
            profiled[i] = loose[i]
    H = np.linalg.inv(shape.cov)
    # Two points of each profile, with two gradients each.
    objective.progress.expect(int(profiled.sum()) * 8 * x.size * objective.folds)
    for i in np.flatnonzero(profiled).tolist():
        profiled[i] = not objective.progress.stop
        for side in (0, 1) if profiled[i] else ():
            found[i, side] = _profile_end(objective, x, value, shape, H, i, found[i, side])
    return np.clip(found, low[:, None], high[:, None]), profiled


def _profile_end(
    objective: Objective, x: np.ndarray, value: float, shape: LikelihoodCurvature, H: np.ndarray, i: int, t: float
) -> float:
    """Return where the profile of entry i has dropped, on the side of t."""
    low, high = objective.limits[i]
    t = float(np.clip(t, low, high))
    before, root_before = float(x[i]), 0.0
    for _ in range(MAX_SECANTS):
        if t == x[i]:
            break
        drop = value - _profile(objective, x, H, i, t)
        root = np.sqrt(max(0.0, 2.0 * drop)) / shape.widened[i]
        if abs(root - Z) < ROOT_TOLERANCE * Z or (root < Z and t in (low, high)):
            break
        slope = (root - root_before) / (t - before)
        # Where it is flat, or rises again: further out.
        after = t + (Z - root) / slope if slope * (t - x[i]) > 0.0 else np.inf * (t - x[i])
        ratio = float(np.clip((after - x[i]) / (t - x[i]), 0.2, 3.0))
        before, root_before, t = t, root, float(np.clip(x[i] + ratio * (t - x[i]), low, high))
    return t


def _profile(objective: Objective, x: np.ndarray, H: np.ndarray, i: int, t: float) -> float:
    """Return the maximum with entry i at t."""
    low, high = np.delete(np.array(objective.limits), i, axis=0).T
    others = np.delete(np.arange(x.size), i)
    rest = objective.pinned([i], np.where(np.arange(x.size) == i, t, x))
    penalty = 0.5 * float(objective.precision[i] * (t - objective.start[i]) ** 2)
    if not others.size:
        return rest.value(np.zeros(0)) - penalty
    across = H[np.ix_(others, others)]
    start = np.clip(x[others] - np.linalg.solve(across, H[others, i]) * (t - x[i]), low, high)
    return quasi_newton(rest, start, across, steps=PROFILE_STEPS)[1] - penalty
