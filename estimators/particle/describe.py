"""What is shown of a cloud: moments, particles, peaks."""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..compiled.context import shown_states
from ..estimator import Options
from ..numerics.jit import ints, jit
from ..numerics.peaks import Peak, peaks_of
from .cloud import EQUAL, MEMBERS, RECOVERIES, block, members, views, weights_of
from .moments import cloud_moments


def moments(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (nx,) and covariance (nx, nx) of a state."""
    mean, cov = np.empty(nx), np.empty((nx, nx))
    cloud_moments(state, nx, members(options), mean, cov)
    return mean, cov


DRAWN = 2000
"""Particles that a view is given at most."""


def points(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Particles to draw (k, nx), k ≤ `DRAWN`, of equal weight: picked by weight at even steps, or all if equal."""
    n = members(options)
    drawn = min(n, DRAWN)
    if state[EQUAL]:
        return block(options, state, nx)[np.arange(drawn) * n // drawn, :nx]
    w, records = weights_of(options, state, nx)
    picked = np.searchsorted(np.cumsum(w), (np.arange(drawn) + 0.5) / drawn)
    return records[np.minimum(picked, n - 1), :nx]


def peaks(options: Options, state: np.ndarray, nx: int) -> list[Peak]:
    """The peaks of the cloud."""
    return peaks_of(points(options, state, nx), views(options, state, nx).circular != 0.0)


def recoveries(state: np.ndarray) -> int:
    """Clouds that were widened, or drawn again from the prior, since the filter started."""
    return int(state[RECOVERIES])


@jit
def describe(context, state, mean, std, cross):
    """Mean, standard deviation and the configured covariances."""
    n = context.nx
    x, cov = np.empty(n), np.empty((n, n))
    cloud_moments(state, n, int(numbers(context)[MEMBERS]), x, cov)
    shown = shown_states(context)
    for k in range(mean.size):
        i = shown[k]
        mean[k] = x[i]
        std[k] = np.sqrt(cov[i, i])
    pairs = ints(context.pairs, 2 * context.n_pairs)
    for k in range(cross.size):
        cross[k] = cov[pairs[2 * k], pairs[2 * k + 1]]
