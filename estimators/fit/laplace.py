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
