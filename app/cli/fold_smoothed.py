"""What `nisus fold --smooth` says of the smoother: how far it was off, and whether it agrees with the filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from estimators.diagnostics.score import Fit, score
from estimators.fold import Fold
from estimators.smoothing.smooth import consistency
from estimators.smoothing.smoothed import Smoothed


class Better(NamedTuple):
    """By name of the state: errors where the truth is known, and consistency with the filter."""

    states: Mapping[str, Fit]
    consistency: Mapping[str, float]

    @staticmethod
    def of(fold: Fold, smoothed: Smoothed) -> Better:
        """What came of smoothing a fold."""
        fits = score(smoothed.instead_of(fold.track), fold.log.events, fold.model, gate=fold.tuning.gate).states
        return Better(fits, consistency(fold.track, smoothed, fold.model))

    def as_dict(self) -> dict[str, Any]:
        """For a script."""
        told = {name: number(value) for name, value in self.consistency.items()}
        return {**errors_dict(self.states), "consistency": told}

    def as_rows(self, units: Mapping[str, str]) -> list[tuple[str, str]]:
        """Names and values, as the report has them."""
        rows = [
            (f"RMSE {name}, smoothed", f"{fit.rmse:.5g} {units[name]}   in the 95 % band: {100 * fit.coverage:.1f} %")
            for name, fit in self.states.items()
        ]
        told = [f"{name} {value:.2f}" for name, value in self.consistency.items() if np.isfinite(value)]
        return [*rows, ("smoother against filter", ", ".join(told) + "   1 where the model holds")] if told else rows


def errors_dict(states: Mapping[str, Fit]) -> dict[str, dict[str, float | None]]:
    """Root mean square errors of states, and how many of them lie in the 95 % band."""
    return {
        "rmse": {name: number(fit.rmse) for name, fit in states.items()},
        "coverage": {name: number(fit.coverage) for name, fit in states.items()},
    }


def number(value: float) -> float | None:
    """As JSON has it: null where there is none."""
    return float(value) if np.isfinite(value) else None
