"""Settings of a tuning version from the result of a fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from config.tuning_schema import EvidenceSection, MovedSection
from estimators.errors import LARGEST
from estimators.fit.dual import shift
from estimators.fit.fit import EntryFit, Fitted
from estimators.fit.judge import PartScore

from .versions import COVERAGE, DIGITS, LIKELIHOOD, NIS, RMSE, Settings


def settings_of(found: Fitted, fitted_on: Sequence[str], note: str = "") -> Settings:
    """Return filter, tuning and held-out scores of a fit.

    Args:
        found: Result of the fit.
        fitted_on: Names of the recordings.
        note: Note of the version.
    """
    tuning, prior = found.setting
    beliefs = {}
    if prior is not None:
        stds = np.sqrt(np.diag(prior[1]))
        beliefs = {
            name: {"mean": float(mean), "std": float(std)}
            for name, mean, std in zip(tuning.model.state_names, prior[0], stds, strict=True)
        }
    return Settings(
        found.estimator,
        tuning,
        note,
        tuple(fitted_on),
        _scores(found.after.held_out),
        beliefs,
        evidence=_evidence(found) if found.proposed else None,
    )


def _scores(part: PartScore) -> dict[str, float]:
    predicted = {**part.sensors, **part.withheld, **part.states}
    scores = {
        NIS: part.nis,
        LIKELIHOOD: part.log_density,
        **{f"{RMSE}.{name}": item.rms for name, item in predicted.items()},
        **{f"{COVERAGE}.{name}": item.coverage for name, item in predicted.items()},
    }
    return {name: float(value) for name, value in scores.items() if np.isfinite(value)}


def _evidence(found: Fitted) -> EvidenceSection:
    return EvidenceSection(
        gain=_rounded(found.verdict.gain) or 0.0,
        error=_rounded(found.verdict.error) or 0.0,
        before={name: float(f"{value:.{DIGITS}g}") for name, value in _scores(found.before.held_out).items()},
        entries={line.key: _moved(line) for line in found.lines if not line.alone},
    )


def _moved(line: EntryFit) -> MovedSection:
    return MovedSection(
        before=line.before,
        after=line.after,
        low=_rounded(line.low),
        high=_rounded(line.high),
        sigma=_rounded(shift(line)) or 0.0,
    )


def _rounded(value: float) -> float | None:
    """Round to four significant digits; None if it is not a number."""
    return float(f"{value:.4g}") if np.isfinite(value) and abs(value) <= LARGEST else None
