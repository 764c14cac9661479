"""Smoothing: the estimate at each event given all measurements of the log, later ones too.

The smoother follows the fold measurement by measurement: rejected, weighted, adapted, accepted again.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..errors import EstimatorError
from ..estimator import MEMBERS, TRAJECTORIES, Estimator
from ..fold import Fold
from ..model.state_space import StateSpaceModel
from ..numerics.linalg import wrapped
from ..registry import ESTIMATORS
from ..track import Track
from .moments_back import MomentsBack
from .trajectories_back import TrajectoriesBack
from .walk import Notes, Smoothed, Walk


def check_smooth(estimator: Estimator, model: StateSpaceModel, options: Mapping[str, float | str]) -> None:
    """Refuse a filter whose estimates of a model cannot be smoothed.

    Raises:
        EstimatorError: With the reason.
    """
    if estimator.smoothing is None:
        able = ", ".join(entry.name for entry in ESTIMATORS.values() if entry.smoothing)
        # Optimal gains are supposed, as below.
        why = ", as its gain is not optimal until it is steady" if estimator.fixed_r else ""
        raise EstimatorError(f"{estimator.name} cannot be smoothed{why}; use {able}")
    if model.considered:
        # The gains of a smoother suppose that those of the filter are optimal. Otherwise its covariance is still right,
        # but can be many times that of the filter.
        names = ", ".join(model.state_names[model.nx - model.considered :])
        raise EstimatorError(
            f"{estimator.name} cannot be smoothed: {model.name} considers {names}, and the smoothed estimate may be "
            "worse than the filtered one; hold (`role: held`) or estimate them to smooth"
        )
    if model.black_box:
        raise EstimatorError(f"{estimator.name} cannot be smoothed: {model.name} is a black box, which is not compiled")
    if estimator.smoothing.holds == MEMBERS:
        members = int(estimator.complete(options)["members"])
        if members < model.nx + 2:
            raise EstimatorError(
                f"{estimator.name} cannot be smoothed: the covariance of {members} members of {model.name} with its "
                f"{model.nx:,} states has no inverse; give at least {model.nx + 2:,} members, better several times that"
            )


def smooth(fold: Fold) -> Smoothed:
    """Smooth what a fold has folded; the fold itself stays as it is.

    Raises:
        EstimatorError: If there is no smoother for its filter and model.
    """
    check_smooth(fold.estimator, fold.model, fold.options)
    out = Smoothed.room_for(fold)
    if fold.n:
        kind = fold.estimator.smoothing
        assert kind is not None
        notes: Notes = TrajectoriesBack(fold, out) if kind.holds == TRAJECTORIES else MomentsBack(fold, kind, out)
        Walk(fold, notes).back()
    return out


MIN_REMOVED_SHARE = 1e-3  # Share of a variance that later measurements must remove; with less, rounding dominates


def consistency(track: Track, smoothed: Smoothed, model: StateSpaceModel) -> dict[str, float]:
    """Return the mean of (x - xˢ)² / (σ² - σˢ²) by shown state; NaN where later measurements carry no information.

    McReynolds' filter-smoother consistency, which needs no truth: where the model holds, the change of an estimate by
    later measurements has the covariance that they remove, Cov(x - xˢ) = P - Pˢ, so the mean is 1. Far above 1 the
    filter is overconfident: f bends within the spread, or Q is too small; the smoother may be worse than the filter.
    """
    moved = wrapped(track.mean - smoothed.mean, [state.circular for state in model.shown_states])
    before = track.std**2
    taken = before - smoothed.std**2
    informed = taken > MIN_REMOVED_SHARE * before
    ratios = np.where(informed, moved**2 / np.where(informed, taken, 1.0), np.nan)
    return {
        state.name: float(np.nanmean(ratios[:, k])) if informed[:, k].any() else np.nan
        for k, state in enumerate(model.shown_states)
    }
