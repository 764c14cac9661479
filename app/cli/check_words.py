"""Faults and units in words, as `nisus check` and the panel say them."""

from __future__ import annotations

import numpy as np

from estimators.diagnostics.sensitivity import Nudge
from estimators.numerics.quantiles import normal_quantile

TWO_SIGMA = normal_quantile(0.975)
"""Standard deviations to either side in a band of 95 %, as charts call it and as the integrity bound has it."""


def size_text(nudge: Nudge, size: float) -> str:
    """The size of a fault without its sign: of a parameter in percent of its value, if it has one; else in its unit."""
    if not np.isfinite(size):
        return "any"
    if nudge.kind == "parameter" and nudge.value:
        return f"{100.0 * size / abs(nudge.value):.3g} %"
    return f"{size:.3g} {nudge.unit}".rstrip()


def subject_text(nudge: Nudge) -> str:
    """What is nudged."""
    return f"{nudge.kind} {nudge.name}"


def range_text(nudge: Nudge, low: float, high: float) -> str:
    """A fault that passes unseen: `parameter magnet_ambient, -31 % to +92 %`."""
    if not (np.isfinite(low) and np.isfinite(high)):
        return f"{subject_text(nudge)}, of any size"
    percent = nudge.kind == "parameter" and bool(nudge.value)
    scale, unit = (100.0 / abs(nudge.value), "%") if percent else (1.0, nudge.unit)
    return f"{subject_text(nudge)}, {scale * low:+.3g} to {scale * high:+.3g} {unit}".rstrip()
