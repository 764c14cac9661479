"""Are the tails of the innovations heavier than a normal distribution's? That needs weights, not particles."""

from __future__ import annotations

import numpy as np

from estimators.diagnostics.calibration import LIMITS, calibrations
from estimators.diagnostics.checklist.posterior import FAR, HEAVY, OFTEN, Tail
from estimators.diagnostics.checklist.posterior import tails as measure

from .claim import NO, UNTOLD, YES, Claim
from .measured import Measured
from .words import digits, percent

QUESTION = "Are the innovations heavy-tailed?"
OF = "excess kurtosis of the innovations"

LEAST_DOF = 3.0
"""Degrees of freedom below which Student's t has hardly a variance; its kurtosis is infinite from four on."""


def heavy(measured: Measured, estimator: str, options: dict[str, float] | None = None) -> tuple[Claim, float]:
    """By the excess kurtosis of the innovations of the filter that is chosen; and Student's t that has as much.

    Source: the excess kurtosis of Student's t is 6 / (ν - 4), so ν = 4 + 6 / κ.
    """
    fold = measured.folded(estimator, options).fold
    track, model = fold.track, measured.twin.model
    found = measure(model, fold.log, track, marginal=fold.marginal)
    if not found:
        return Claim("tails", QUESTION, UNTOLD, None, HEAVY, OF, "no row has enough readings"), np.inf
    worst: Tail = max(found, key=lambda tail: tail.kurtosis)
    rows = [tail for tail in found if tail.heavy]
    reason = (
        f"{worst.row} has excess kurtosis {digits(worst.kurtosis)} and {percent(worst.far)} of its {worst.n:,} "
        f"innovations beyond {FAR:g} σ, the most of {len(found)} rows of {estimator}"
    )
    # Of many rows a few look so by chance.
    if len(rows) <= OFTEN * len(found):
        return Claim("tails", QUESTION, NO, worst.kurtosis, HEAVY, OF, reason), np.inf
    related = [
        entry
        for entry in calibrations(model, fold.log.events, track, gate=measured.twin.tuning.gate, marginal=fold.marginal)
        if entry.role == "used" and entry.correlation.beyond(-LIMITS.correlation, LIMITS.correlation)
    ]
    if any(entry.subject == worst.row for entry in related):
        reason += (
            "; they are correlated too, so these are errors of the model, and weights would keep good readings out"
        )
        return Claim("tails", QUESTION, NO, worst.kurtosis, HEAVY, OF, reason), np.inf
    dof = max(LEAST_DOF, 4.0 + 6.0 / worst.kurtosis)
    reason += f"; Student's t with 4 + 6 / κ = {digits(dof)} degrees of freedom has as heavy ones"
    return Claim("tails", QUESTION, YES, worst.kurtosis, HEAVY, OF, reason), dof
