"""What a fit found, as what a tuning version is made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimators.fit.fit import Fitted

from .figures import COVERAGE, LIKELIHOOD, NIS, RMSE
from .keep import Settings


def settings_of(found: Fitted, fitted_on: Sequence[str], note: str = "") -> Settings:
    """Filter and tuning of a fit with what they were worth on the blocks that were held out.

    Args:
        found: What came of the fit.
        fitted_on: Names of the recordings.
        note: What was tried.
    """
    tuning, prior = found.setting
    part = found.after.held_out
    predicted = {**part.sensors, **part.withheld, **part.states}
    scores = {
        NIS: part.nis,
        LIKELIHOOD: part.log_density,
        **{f"{RMSE}.{name}": item.rms for name, item in predicted.items()},
        **{f"{COVERAGE}.{name}": item.coverage for name, item in predicted.items()},
    }
    beliefs = {}
    if prior is not None:
        stds = np.sqrt(np.diag(prior[1]))
        beliefs = {
            name: {"mean": float(mean), "std": float(std)}
            for name, mean, std in zip(tuning.model.state_names, prior[0], stds, strict=True)
        }
    known = {name: float(value) for name, value in scores.items() if np.isfinite(value)}
    return Settings(found.estimator, tuning, note, tuple(fitted_on), known, beliefs)
