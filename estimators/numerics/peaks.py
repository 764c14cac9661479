"""Peaks of a cloud of points: place, share of the points and spread of each.

A kernel density of the whitened points links every point to its nearest neighbour of higher density (quick shift); the
roots are candidates. Two candidates are one peak unless the density dips between them. Angles enter as points of the
unit circle, so a peak at ±π stays one peak.

Sources: Vedaldi & Soatto (2008), Quick shift and kernel methods for mode seeking, doi:10.1007/978-3-540-88693-8_52;
Rodriguez & Laio (2014), Clustering by fast search and find of density peaks, doi:10.1126/science.1242072;
Silverman (1986), Density Estimation, section 4.3.2, for the bandwidth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .linalg import wrapped

MAX_DENSITY_POINTS = 400
"""Points of the kernel density; its cost grows with their square."""

VALLEY_DENSITY_SHARE = 0.6
"""Share of the lower peak's density below which the density between two peaks must fall to separate them."""

MIN_PEAK_SHARE = 0.02
"""Share of the points below which a peak is a tail of the nearest one."""

MIN_SPREAD_SHARE = 1e-12
"""Spread, as a share of the largest value, below which a column has none."""

MAX_CANDIDATE_PEAKS = 12
"""Largest number of candidate peaks."""


class Peak(NamedTuple):
    """Peak: share of the probability, mean (nx,) and covariance (nx, nx)."""

    weight: float
    mean: np.ndarray
    cov: np.ndarray


def peaks_of(points: np.ndarray, circular: np.ndarray) -> list[Peak]:
    """Return the peaks of points of equal weight, the heaviest first.

    Args:
        points: States, shape (n, nx).
        circular: For each state whether it is an angle, shape (nx,), bool.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return []
    places = _whitened(points, circular)
    few = places[np.arange(min(len(places), MAX_DENSITY_POINTS)) * len(places) // min(len(places), MAX_DENSITY_POINTS)]
    label = _peaks(few)
    if label.max() == 0:
        return [_peak(points, circular, 1.0)]
    whole = label[np.argmin(_squares(places, few), axis=1)]
    parts = [points[whole == k] for k in range(label.max() + 1)]
    found = [_peak(part, circular, len(part) / len(points)) for part in parts if len(part)]
    return sorted(found, key=lambda peak: -peak.weight)


def _whitened(points: np.ndarray, circular: np.ndarray) -> np.ndarray:
    """Return coordinates in which the cloud has unit covariance, except in directions of very little extent."""
    columns = []
    for j in range(points.shape[1]):
        column = points[:, j]
        pair = np.column_stack((np.cos(column), np.sin(column))) if circular[j] else column[:, None]
        size = float(np.abs(pair).max())
        pair = pair - pair.mean(axis=0)
        # One scale for both coordinates of an angle: a short arc must stay an arc.
        spread = float(pair.std(axis=0).max())
        # Copies of one particle differ from their mean by its rounding alone, which is no spread.
        columns.append(pair / spread if spread > MIN_SPREAD_SHARE * size else np.zeros_like(pair))
    flat = np.hstack(columns)
    values, vectors = np.linalg.eigh(flat.T @ flat / len(flat))
    return flat @ vectors / np.sqrt(np.maximum(values, 0.01))


def _squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the squared distances of all pairs."""
    return np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2.0 * a @ b.T, 0.0)


def _peaks(places: np.ndarray) -> np.ndarray:
    """Return the index of each point's peak."""
    n, d = places.shape
    # Copies of a particle are no further evidence of where the density lies.
    width = (4.0 / ((d + 2) * len(np.unique(places, axis=0)))) ** (1.0 / (d + 4))

    def density(at: np.ndarray) -> np.ndarray:
        return np.exp(-0.5 * _squares(at, places) / width**2).sum(axis=1)

    squares = _squares(places, places)
    height = np.exp(-0.5 * squares / width**2).sum(axis=1)
    order = np.lexsort((np.arange(n), -height))
    rank = np.empty(n, int)
    rank[order] = np.arange(n)
    squares[rank[None, :] >= rank[:, None]] = np.inf
    parent = np.argmin(squares, axis=1)
    jump = squares[np.arange(n), parent]
    # Dense and far from anything denser: Rodriguez & Laio (2014). Outliers are far, but not dense.
    chance = height * np.sqrt(np.where(np.isfinite(jump), jump, jump[np.isfinite(jump)].max(initial=1.0)))
    far = jump > width**2
    root = far & (chance >= np.sort(chance[far])[-min(int(far.sum()), MAX_CANDIDATE_PEAKS)])
    root[order[0]] = True
    label = np.empty(n, int)
    tops: list[int] = []
    for i in order:
        if root[i]:
            label[i] = len(tops)
            tops.append(int(i))
        else:
            label[i] = label[parent[i]]
    # Trees of too few points join their top's denser neighbour, from the lowest up.
    for k in range(len(tops) - 1, 0, -1):
        if np.mean(label == k) < MIN_PEAK_SHARE:
            label[label == k] = label[parent[tops[k]]]
    trees, label = np.unique(label, return_inverse=True)
    tops = [tops[k] for k in trees]
    # Candidates from the highest down; each joins the first higher one from which no valley parts it.
    steps = np.linspace(0.0, 1.0, 9)[1:-1, None]
    joined: list[int] = []
    for k, top in enumerate(tops):
        into = k
        by_distance = sorted(range(k), key=lambda other: float(((places[tops[other]] - places[top]) ** 2).sum()))
        for other in by_distance:
            between = density(places[top] + steps * (places[tops[other]] - places[top]))
            if between.min() > VALLEY_DENSITY_SHARE * height[top] or not _valley(places, label, k, other):
                into = joined[other]
                break
        joined.append(into)
    label = np.array(joined)[label]
    kept = [k for k in dict.fromkeys(joined) if np.mean(label == k) >= MIN_PEAK_SHARE] or [joined[0]]
    centres = places[[tops[k] for k in kept]]
    nearest = np.argmin(_squares(places, centres), axis=1)
    position = {k: i for i, k in enumerate(kept)}
    return np.array([position.get(k, near) for k, near in zip(label, nearest, strict=True)])


def _valley(places: np.ndarray, label: np.ndarray, a: int, b: int) -> bool:
    """Return whether two trees stay separate when their points are projected on the line between their means.

    One dimension has points enough for a density, where many dimensions have gaps everywhere.
    """
    first, second = places[label == a], places[label == b]
    line = second.mean(axis=0) - first.mean(axis=0)
    length = float(np.linalg.norm(line))
    if length == 0.0:
        return False
    s, t = first @ line / length, second @ line / length
    both = np.concatenate((s, t))
    # The narrower one's width, but one that still shows the wider one: copies of one particle have none of their own.
    narrow, wide = sorted((float(s.std()), float(t.std())))
    width = 1.06 * max(1e-6, narrow, 0.1 * wide) * len(both) ** -0.2
    grid = np.linspace(s.mean(), t.mean(), 25)
    density = np.exp(-0.5 * ((grid[:, None] - both) / width) ** 2).sum(axis=1)
    lower = min(density[:8].max(), density[-8:].max())
    return bool(density[8:-8].min() < VALLEY_DENSITY_SHARE * lower)


def _peak(points: np.ndarray, circular: np.ndarray, weight: float) -> Peak:
    """Return one peak from its points; angles are averaged about their mean direction."""
    mean = points.mean(axis=0)
    for j in np.flatnonzero(circular):
        mean[j] = np.arctan2(np.sin(points[:, j]).mean(), np.cos(points[:, j]).mean())
    deviations = wrapped(points - mean, circular)
    return Peak(weight, mean, deviations.T @ deviations / len(points))
