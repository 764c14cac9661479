"""Do the innovations of the filter that is chosen bear out its bands? If not, its tuning or the model is wrong."""

from __future__ import annotations

import numpy as np

from config.tunings import named
from estimators.diagnostics.calibration import LIMITS, calibrations
from estimators.diagnostics.innovations import mean_nis

from .claim import NO, UNTOLD, YES, Claim
from .measured import Measured
from .words import digits

QUESTION = "Are the innovations as large and as white as the filter says?"
OF = "mean NIS a degree of freedom"


def consistent(measured: Measured, estimator: str, options: dict[str, float] | None = None) -> Claim:
    """By mean NIS, and by the scale and correlation of each row with their intervals."""
    twin = measured.twin
    fold = measured.folded(estimator, options).fold
    nis = mean_nis(fold.track, fold.tuning.gate)
    if not np.isfinite(nis):
        return Claim("consistent", QUESTION, UNTOLD, None, 1.0, OF, "no reading was used")
    found = calibrations(
        twin.model, fold.log.events, fold.track, gate=fold.tuning.gate, marginal=fold.marginal, limits=LIMITS
    )
    rows = [entry for entry in found if entry.role == "used" and np.isfinite(entry.scale.high)]
    if not rows:
        return Claim("consistent", QUESTION, UNTOLD, nis, 1.0, OF, "no row has enough readings for an interval")
    wide = 1.0 + LIMITS.width
    size = [entry for entry in rows if entry.scale.beyond(1.0 / wide, wide)]
    related = [entry for entry in rows if entry.correlation.beyond(-LIMITS.correlation, LIMITS.correlation)]
    reason = f"{estimator}: mean NIS {digits(nis)} a degree of freedom"
    if not size and not related:
        reason += (
            f"; every band is right within a quarter, and no correlation is beyond {LIMITS.correlation:g} "
            f"({len(rows)} row{'s' if len(rows) > 1 else ''})"
        )
        return Claim("consistent", QUESTION, YES, nis, 1.0, OF, reason)
    remedies = []
    if size:
        one = max(size, key=lambda entry: abs(np.log(entry.scale.value)))
        reason += f"; bands of {one.subject} would have to be {digits(one.scale.value)} times as wide"
        remedies.append(f"noises are off: nisus tune {named(twin.path)} fits Q and R to the log")
    if related:
        one = max(related, key=lambda entry: abs(entry.correlation.value))
        reason += f"; innovations of {one.subject} follow one another with {one.correlation.value:+.2f}"
        remedies.append(
            "too little Q, or a state is missing" if one.correlation.value > 0.0 else "too much Q against R"
        )
    return Claim("consistent", QUESTION, NO, nis, 1.0, OF, reason, "; ".join(remedies))
