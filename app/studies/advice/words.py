"""Numbers as an advice says them."""

from __future__ import annotations

import math

from estimators.diagnostics.sensitivity.checklist import LEAST
from estimators.diagnostics.sensitivity.responses import digits

__all__ = ["apart_text", "bytes_text", "digits", "percent", "seconds_text"]

_BYTES = ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB"), (1.0, "B"))
_SECONDS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))


def apart_text(sigma: float) -> str:
    """A distance in σ; what is very small is said to be."""
    return f"less than {LEAST:g} σ" if sigma < LEAST else f"{digits(sigma)} σ"


def bytes_text(count: float) -> str:
    """A number of bytes with a prefix."""
    size, unit = next((step for step in _BYTES if count >= step[0]), _BYTES[-1])
    return f"{count / size:.3g} {unit}"


def seconds_text(seconds: float) -> str:
    """A time below minutes with a prefix."""
    size, unit = next((step for step in _SECONDS if seconds >= step[0]), _SECONDS[-1])
    return f"{seconds / size:.3g} {unit}"


def percent(share: float) -> str:
    """A share in percent: whole from ten on, two digits below; what is nearly all is not said to be all."""
    if not math.isfinite(share):
        return "unknown"
    if 0.995 <= share < 1.0:
        return f"{math.floor(10_000.0 * share) / 100.0:.2f} %"
    return f"{100.0 * share:.0f} %" if share >= 0.1 else f"{100.0 * share:.2g} %"
