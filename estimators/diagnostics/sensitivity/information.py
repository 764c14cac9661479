"""What the innovations tell of each nudge: Fisher information.

With innovations ν ~ N(0, S), white, and dν_i what one unit of nudge i does to them, the information of the log is

    F_ij = Σ dν_iᵀ S⁻¹ dν_j

where the filter has already allowed for what it does not know of the states. What a nudge does to S itself tells
something too; that is left out, so deviations come out too large rather than too small.

Source: Kay (1993), Fundamentals of Statistical Signal Processing: Estimation Theory, 3.9; for the likelihood by
innovations Schweppe (1965), doi:10.1109/TIT.1965.1053737.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .nudges import Nudge

LEAST = 1e-10
"""Eigenvalue of the information scaled to a unit diagonal, below which differences cannot tell it from zero."""

PRESENT = 1e-3
"""Share of a nudge in a direction, below which it has no part in it."""


PART = 0.05
"""Of the largest part of a direction, below which another is not named."""


class Direction(NamedTuple):
    """A combination of nudges, and how well the log tells it.

    `weights` (k,) are in the nudges' scales, with unit norm; `deviation`, of the combination, in the same: beyond 1,
    the log does not tell it to the size of the values themselves. `text` says it in words.
    """

    weights: np.ndarray
    deviation: float
    text: str


class Uncertainty(NamedTuple):
    """How well each of some nudges can be told from a log, if all of them are unknown together.

    deviation (k,) in the nudges' units, infinite where the log cannot tell; `alone` (k,) the same where all others are
    known. correlation (k, k) of the estimates: near ±1, one takes the blame for the other. `directions`, the worst told
    first.
    """

    nudges: tuple[Nudge, ...]
    deviation: np.ndarray
    alone: np.ndarray
    correlation: np.ndarray
    directions: tuple[Direction, ...]


def information(whitened: Sequence[np.ndarray]) -> np.ndarray:
    """F (k, k) of k responses S^-1/2 dν, each (N, ny), NaN where there is none."""
    rows = np.array([np.nan_to_num(each).ravel() for each in whitened])
    return rows @ rows.T


def uncertainty(fisher: np.ndarray, nudges: Sequence[Nudge]) -> Uncertainty:
    """Invert the information (k, k) of k nudges, as far as it can be."""
    k = len(nudges)
    alone = _reciprocal(np.sqrt(np.diag(fisher)))
    seen = np.isfinite(alone)
    unit = np.where(seen, alone, 0.0)
    values, vectors = np.linalg.eigh(fisher * np.outer(unit, unit))
    told = values > LEAST
    shares = vectors**2
    spread = shares[:, told] @ (1.0 / values[told])
    lost = ~seen | (shares[:, ~told].sum(axis=1) > PRESENT**2)
    deviation = np.where(lost, np.inf, np.sqrt(spread) * unit)
    # Of what the log cannot tell, the null space says which goes with which; the rest is nothing beside it.
    weight = np.where(told, 1.0 / np.maximum(values, LEAST), 1.0 / LEAST)
    cov = (vectors * weight) @ vectors.T
    root = np.sqrt(np.diag(cov)) if k else np.zeros(0)
    return Uncertainty(tuple(nudges), deviation, alone, cov / np.outer(root, root), directions(fisher, nudges))


def directions(fisher: np.ndarray, nudges: Sequence[Nudge]) -> tuple[Direction, ...]:
    """Combinations of nudges that the log tells independently of one another, the worst told first."""
    scale = np.array([nudge.scale for nudge in nudges])
    values, vectors = np.linalg.eigh(fisher * np.outer(scale, scale))
    least = LEAST * max(float(values.max(initial=0.0)), np.finfo(float).tiny)
    found = []
    for value, weights in zip(values, vectors.T, strict=True):
        weights = weights * (np.sign(weights[np.argmax(np.abs(weights))]) or 1.0)
        deviation = float(value**-0.5) if value > least else np.inf
        found.append(Direction(weights, deviation, in_words(weights, nudges)))
    return tuple(found)


def in_words(weights: np.ndarray, nudges: Sequence[Nudge], most: int = 4) -> str:
    """A combination of nudges: its largest parts, parameters in percent of their values, the others in units."""
    order = np.argsort(-np.abs(weights), kind="stable")
    order = order[np.abs(weights[order]) >= PART * np.abs(weights[order[0]])]
    largest = np.abs(weights[order[0]])
    parts = [nudges[j].in_words(float(weights[j] / largest) * nudges[j].scale) for j in order[:most]]
    more = f" and {len(order) - most} more" if len(order) > most else ""
    return (f"{parts[0]} with {', '.join(parts[1:])}" if len(parts) > 1 else parts[0]) + more


def _reciprocal(values: np.ndarray) -> np.ndarray:
    return np.divide(1.0, values, out=np.full(values.shape, np.inf), where=values > 0.0)
