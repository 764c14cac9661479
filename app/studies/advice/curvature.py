"""Do f and h curve within the spread of the estimate? The EKF goes by tangents, the UKF by points."""

from __future__ import annotations

import numpy as np

from estimators.diagnostics.calibration import LIMITS

from .claim import NO, UNTOLD, YES, Claim
from .linear import APART, worst
from .measured import Measured
from .words import apart_text, digits


def curvature(measured: Measured) -> Claim:
    """By how far the two filters are apart in σ along the log; also how much likelier one finds the readings."""
    question = "Is the curvature of f and h significant over the spread of the estimate?"
    found = measured.linearity
    if found.reason:
        return Claim("curvature", question, UNTOLD, None, LIMITS.bias, APART, found.reason)
    name, apart = worst(found)
    reason = f"95 % of the time ekf and ukf are {apart_text(apart)} apart, most in {name}"
    if not np.isfinite(apart):
        reason = f"ekf loses {name} where ukf does not"
    return Claim(
        "curvature", question, YES if apart > LIMITS.bias else NO, apart, LIMITS.bias, APART, reason + _gain(measured)
    )


def _gain(measured: Measured) -> str:
    """How much likelier the unscented filter finds the readings, in words."""
    one, other = (measured.likelihood(name) for name in ("ekf", "ukf"))
    if not (np.isfinite(one) and np.isfinite(other)):
        return ""
    return f"; ukf finds the readings {digits(other - one)} nats a reading likelier" if other > one else ""
