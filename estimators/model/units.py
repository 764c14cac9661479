"""Units made of others, as a page writes them."""

from __future__ import annotations


def squared(unit: str) -> str:
    """The unit of a variance: °C → °C², m/s → (m/s)²."""
    if not unit or unit == "1":
        return unit
    return f"({unit})²" if "/" in unit or " " in unit or "·" in unit else f"{unit}²"
