"""Faults in words, as a check and the panel say them."""

from __future__ import annotations

import numpy as np

from .nudges import PARAMETER, Nudge


def digits(value: float, sign: str = "") -> str:
    """A number to three digits, with an exponent only where it would be longer without: `2,280`, `0.0375`, `1.8e+10`.

    `sign`: "+" shows that of a positive number too. Zero has none.
    """
    value = value or 0.0
    if 1e3 <= abs(value) < 1e6:
        return f"{float(f'{value:.3g}'):{sign},.0f}"
    return f"{value:{sign if value else ''}.3g}"


def subject_text(nudge: Nudge) -> str:
    """What is nudged."""
    return f"{nudge.kind} {nudge.name}"


def size_text(nudge: Nudge, size: float) -> str:
    """The size of a fault without its sign: of a parameter in percent of its value, if it has one; else in its unit."""
    if nudge.kind == PARAMETER and nudge.value:
        return f"{digits(100.0 * size / abs(nudge.value))} %"
    return f"{digits(size)} {nudge.unit}".rstrip()


def range_text(nudge: Nudge, low: float, high: float) -> str:
    """From where to where a fault passes unseen: `-31 to +92 %`, or `± 2.51 °C`."""
    if not (np.isfinite(low) and np.isfinite(high)):
        return "any size"
    percent = nudge.kind == PARAMETER and bool(nudge.value)
    scale, unit = (100.0 / abs(nudge.value), "%") if percent else (1.0, nudge.unit)
    first, last = digits(scale * low, "+"), digits(scale * high, "+")
    both = f"± {last[1:]}" if first[1:] == last[1:] and first != last else f"{first} to {last}"
    return f"{both} {unit}".rstrip()


def fault_text(nudge: Nudge, low: float, high: float) -> str:
    """A fault that passes unseen: `parameter magnet_ambient, -31 to +92 %`."""
    return f"{subject_text(nudge)}, {range_text(nudge, low, high)}"
