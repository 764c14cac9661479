"""Are the tails of the innovations heavier than a normal distribution's? That needs weights, not particles."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimators.diagnostics.calibration import LIMITS, calibrations
from estimators.diagnostics.sensitivity.posterior import FAR, HEAVY, OFTEN, Tail
from estimators.diagnostics.sensitivity.posterior import tails as measure
from estimators.registry import find_entry

from .claim import NO, UNTOLD, YES, Claim
from .linear import STEADY
from .measured import Measured
from .words import digits, percent

QUESTION = "Are the innovations heavy-tailed?"
OF = "excess kurtosis of the innovations"

WORSE = 0.01
"""Share by which weights may make the mean innovation larger; where the asset jumps they make it much larger."""

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
    # A kurtosis tells no more figures; more would differ each time that the lines are put in and asked for again.
    dof = float(f"{max(LEAST_DOF, 4.0 + 6.0 / worst.kurtosis):.2g}")
    reason += f"; Student's t with 4 + 6 / κ = {digits(dof)} degrees of freedom has as heavy ones"
    weighing, weighted = with_weights(estimator, dof)
    if not weighted:
        return Claim("tails", QUESTION, YES, worst.kurtosis, HEAVY, OF, f"{reason}; {estimator} cannot weigh"), dof
    other = measured.folded(weighing, weighted).fold.track
    both = np.isfinite(track.innovation) & np.isfinite(other.innovation)
    scale = np.where(both, np.nanmedian(np.abs(track.innovation), axis=0), 1.0)
    before, after = (float(np.mean(np.abs(one.innovation / scale)[both])) for one in (track, other))
    change = after / before - 1.0
    reason += f"; weighed so, the innovations are {100 * abs(change):.2g} % {'larger' if change > 0 else 'smaller'}"
    if change > WORSE:
        reason += ": it is the asset that jumps, not the sensor, and weights would keep good readings out"
        return Claim("tails", QUESTION, NO, worst.kurtosis, HEAVY, OF, reason), np.inf
    return Claim("tails", QUESTION, YES, worst.kurtosis, HEAVY, OF, reason), dof


def with_weights(estimator: str, dof: float) -> tuple[str, dict[str, float]]:
    """The filter with Student's t, and its options, none if it has none; a fixed gain gives way to one that follows."""
    name = "kf" if estimator == STEADY else estimator
    entry = find_entry(name)
    if all(option.name != "robust" for option in entry.options):
        return name, {}
    weighted: Mapping[str, float | str] = {"robust": "student-t", "dof": dof}
    return name, {key: value for key, value in entry.complete(weighted).items() if key in weighted}
