"""Whether filter and smoother agree, which needs no truth: McReynolds' filter-smoother consistency.

Where the model holds, what the later readings move an estimate by has the covariance that they take from it,
Cov(x - xˢ) = P - Pˢ, so the mean of (x - xˢ)² / (σ² - σˢ²) is 1. Far above it the model is less certain than it says: f
bends within the spread, or Q is too small, and the smoother may be worse than the filter.
"""

from __future__ import annotations

import numpy as np

from ..model.state_space import StateSpaceModel
from ..track import Track
from .smoothed import Smoothed

LEAST = 1e-3
"""Share of a variance that later readings must take; of less, rounding makes the most."""


def consistency(track: Track, smoothed: Smoothed, model: StateSpaceModel) -> dict[str, float]:
    """Of each shown state the mean of (x - xˢ)² / (σ² - σˢ²); NaN where later readings say nothing of it.

    Args:
        track: The filter's.
        smoothed: What came of it.
        model: The model.
    """
    moved = track.mean - smoothed.mean
    turns = np.array([state.circular for state in model.shown_states], bool)
    moved[:, turns] = (moved[:, turns] + np.pi) % (2.0 * np.pi) - np.pi
    before = track.std**2
    taken = before - smoothed.std**2
    told = taken > LEAST * before
    ratios = np.where(told, moved**2 / np.where(told, taken, 1.0), np.nan)
    return {
        state.name: float(np.nanmean(ratios[:, k])) if told[:, k].any() else np.nan
        for k, state in enumerate(model.shown_states)
    }
