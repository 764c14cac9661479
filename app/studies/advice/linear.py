"""Are f and h linear, and if so, is one gain enough?"""

from __future__ import annotations

import numpy as np

from estimators.diagnostics.calibration import LIMITS
from estimators.diagnostics.sensitivity.checklist import QUANTILE, Linearity
from estimators.errors import EstimatorError
from estimators.log import READING
from estimators.registry import find_entry, unfit

from .claim import NO, UNTOLD, YES, Claim
from .measured import Measured
from .words import apart_text, digits, percent

STEADY = "kf-steady"

APART = "σ between ekf and ukf 95 % of the time"

EXACT = 1e-9
"""Of a σ; what two filters of a linear model differ by is rounding."""

UNEVEN = 0.01
"""Share of the period by which the time between two readings may differ from it."""

LOST = 0.001
"""Share of the intervals that may differ: a fixed gain knows nothing of a reading that is lost or late."""


def worst(found: Linearity) -> tuple[str, float]:
    """The state or sensor row in which the linearised and the unscented filter are farthest apart; how far, σ."""
    most = max((*found.states, *found.rows), key=lambda item: item.most)
    return most.name, most.most


def linear(measured: Measured) -> Claim:
    """By the model's own word, or because linearising changes nothing anywhere in the log."""
    question = "Are f and h linear?"
    of = APART
    found, model = measured.linearity, measured.twin.model
    if found.reason:
        if model.linear:
            return Claim("linear", question, YES, None, EXACT, of, "the model says so: linear=True")
        return Claim("linear", question, UNTOLD, None, EXACT, of, found.reason)
    name, apart = worst(found)
    told = f"95 % of the time ekf and ukf are {apart_text(apart)} apart (most in {name})"
    if model.linear:
        return Claim("linear", question, YES, apart, EXACT, of, f"the model says so (linear=True), and {told}")
    if apart <= EXACT:
        remedy = "say linear=True in the model, and kf applies: it finds F once where ekf finds it at every step"
        return Claim("linear", question, YES, apart, EXACT, of, f"{told}, which is rounding", remedy)
    return Claim("linear", question, NO, apart, EXACT, of, told)


def steady(measured: Measured) -> tuple[Claim, float]:
    """Whether a gain that is fixed would do, and the period for which: time-invariant, one sensor, regular readings."""
    question = "Is it time-invariant, and do readings come regularly and never fail?"
    of = "of the intervals between readings off the period by more than 1 %"
    twin, log = measured.twin, measured.log
    against = unfit(find_entry(STEADY), twin.model)
    if against:
        return Claim("steady", question, NO, None, LOST, of, f"{STEADY} does not apply: {against}"), 0.0
    value = log.value[: log.n, : len(twin.model.sensors[0].rows)]
    there = (log.kind[: log.n] == READING) & np.isfinite(value).all(axis=1)
    apart = np.diff(log.t[: log.n][there]) * 1e-9
    if not apart.size:
        return Claim("steady", question, UNTOLD, None, LOST, of, "the log has one reading"), 0.0
    period = float(np.median(apart))
    uneven = float(np.mean(np.abs(apart - period) > UNEVEN * period))
    reason = f"{twin.model.sensor_names[0]} reads every {digits(period)} s, with {percent(uneven)} of the intervals off"
    if uneven > LOST:
        return Claim("steady", question, NO, uneven, LOST, of, f"{reason}: the gain has to follow them"), period
    try:
        one, other = (
            measured.folded(name, given).fold.track for name, given in ((STEADY, {"period": period}), ("kf", {}))
        )
    except EstimatorError as error:
        return Claim("steady", question, NO, uneven, LOST, of, str(error)), period
    with np.errstate(all="ignore"):
        share = np.abs(one.mean - other.mean) / other.std
    far = float(np.nanquantile(np.nanmax(share, axis=1), QUANTILE))
    said = f"{reason}; 95 % of the time {STEADY} is {apart_text(far)} from kf, where {LIMITS.bias:g} would matter"
    of = f"σ between {STEADY} and kf 95 % of the time"
    return Claim("steady", question, YES if far <= LIMITS.bias else NO, far, LIMITS.bias, of, said), period
