"""How many members, how far a reading reaches, how much inflation: by sweep, the predictive likelihood decides."""

from __future__ import annotations

import numpy as np

from estimators.errors import EstimatorError, NisusError
from estimators.fold import Fold
from estimators.registry import checked, find_entry

from .claim import UNTOLD, YES, Claim
from .measured import Measured, likelihood_of
from .words import bytes_text, digits

PREFERRED = ("ensrf", "letkf", "etkf", "enkf")
"""Filters of large states, the first that applies is taken: those that localise and draw no perturbations first."""

MEMBERS = (20.0, 40.0, 80.0)
REACH = (0.05, 0.1, 0.2, 0.4)
"""Radii that are tried, as shares of the extent of the field."""

INFLATION = (1.0, 1.02, 1.05, 1.1)

MARGIN = 0.01
"""Nats a value; what is less likely by no more than this is as good, and the cheaper one is taken."""

BUDGET = 2.0
"""Seconds of one processor for each fold of the sweep."""


def sweep(measured: Measured, estimator: str) -> tuple[list[Claim], dict[str, float]]:
    """Radius first, with the members in the middle, then inflation, then members: claims and options."""
    options: dict[str, float] = {"members": MEMBERS[1]}
    has = {option.name for option in find_entry(estimator).options}
    claims = []
    if radii := _radii(measured, estimator):
        claims.append(_best(measured, estimator, options, "radius", radii, "How far does a reading reach?"))
    if "inflation" in has:
        values = list(INFLATION)
        claims.append(_best(measured, estimator, options, "inflation", values, "How much inflation does it need?"))
    claims.append(_best(measured, estimator, options, "members", list(MEMBERS), "How many members does it need?"))
    return claims, options


def _best(
    measured: Measured, estimator: str, options: dict[str, float], name: str, values: list[float], question: str
) -> Claim:
    """Try the values of one option, the others as they are; the first within the margin of the best is taken."""
    found = _likelihoods(measured, estimator, [{**options, name: value} for value in values])
    of = f"{name} of {estimator}, the likeliest within {MARGIN:g} nats a value"
    if not np.any(np.isfinite(found)):
        return Claim(name, question, UNTOLD, None, None, of, f"{estimator} fails with every {name}")
    best = float(np.nanmax([value if np.isfinite(value) else np.nan for value in found]))
    chosen = next(value for value, nats in zip(values, found, strict=True) if nats >= best - MARGIN)
    options[name] = chosen
    table = ", ".join(f"{digits(value)}: {nats:.3f}" for value, nats in zip(values, found, strict=True))
    reason = f"log-likelihood a value of a reading, by {name}: {table}"
    if name == "members":
        n = measured.twin.model.nx
        reason += (
            f"; two states that know nothing of each other look correlated by 1 / √{chosen:.0f} = "
            f"{1.0 / np.sqrt(chosen):.2f} by chance, and {chosen:.0f} × {n:,} × 8 B = {bytes_text(8.0 * chosen * n)}"
        )
    return Claim(name, question, YES, chosen, best, of, reason)


def _likelihoods(measured: Measured, estimator: str, tried: list[dict[str, float]]) -> list[float]:
    """Mean log-likelihood of a value, over the events that all of them folded within the budget."""
    folds: list[Fold | None] = []
    for options in tried:
        try:
            folds.append(measured.folded(estimator, options, BUDGET).fold)
        except NisusError:
            folds.append(None)
    n = min((fold.n for fold in folds if fold is not None), default=0)
    rows = max(len(sensor.rows) for sensor in measured.twin.model.sensors)
    return [-np.inf if fold is None else likelihood_of(fold, n) / rows for fold in folds]


def _radii(measured: Measured, estimator: str) -> list[float]:
    """Radii to try, shares of the largest extent; none where the filter has no radius, or places are not known."""
    model, entry = measured.twin.model, find_entry(estimator)
    places = model.positions()
    if places is None or all(option.name != "radius" for option in entry.options):
        return []
    extent = float(np.max(np.ptp(places, axis=0)))
    try:
        checked(entry, model, {"radius": extent})
    except EstimatorError:  # the sensors have no places
        return []
    return [share * extent for share in REACH]
