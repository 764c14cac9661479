"""Faults in words, as a check and the panel say them."""

from __future__ import annotations

import numpy as np

from .nudges import PARAMETER, Nudge


def subject_text(nudge: Nudge) -> str:
    """What is nudged."""
    return f"{nudge.kind} {nudge.name}"


def size_text(nudge: Nudge, size: float) -> str:
    """The size of a fault without its sign: of a parameter in percent of its value, if it has one; else in its unit."""
    if nudge.kind == PARAMETER and nudge.value:
        return f"{100.0 * size / abs(nudge.value):.3g} %"
    return f"{size:.3g} {nudge.unit}".rstrip()


def range_text(nudge: Nudge, low: float, high: float) -> str:
    """From where to where a fault passes unseen: `-31 to +92 %`."""
    if not (np.isfinite(low) and np.isfinite(high)):
        return "any size"
    percent = nudge.kind == PARAMETER and bool(nudge.value)
    scale, unit = (100.0 / abs(nudge.value), "%") if percent else (1.0, nudge.unit)
    return f"{scale * low:+.3g} to {scale * high:+.3g} {unit}".rstrip()


def fault_text(nudge: Nudge, low: float, high: float) -> str:
    """A fault that passes unseen: `parameter magnet_ambient, -31 to +92 %`."""
    return f"{subject_text(nudge)}, {range_text(nudge, low, high)}"
