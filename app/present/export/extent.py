"""What a value axis spans: as much as says something, so that one wild value does not flatten all others.

As on the page (app/web/page/ranges.js); what lies outside is marked at the edge (svg.py).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

MARGIN = 0.06
"""Of the span, to either side."""

SETTLING = 0.1
"""Share of the points, the first ones, in which a line may settle."""

FEW = 0.05
"""Share of the dots, at either end, that may be wild."""

FAR = 1.0
"""Times the span of all others, beyond which a value does not rule the axis."""

WIDE, USUAL = 8.0, 0.2
"""Times the usual width of a band beyond which it does not rule the axis, and the share of rows whose is narrower."""

Band = tuple[np.ndarray, np.ndarray]


def extent(lines: Sequence[np.ndarray], bands: Sequence[Band], dots: Sequence[np.ndarray]) -> tuple[float, float]:
    """Lines once they have settled, bands, nearly all of the dots; of the rest what is not far from these.

    Args:
        lines: Values (n,) each; NaN is a gap.
        bands: Lower and upper edges (n,).
        dots: Values (n,) each.
    """
    parts = [line[int(SETTLING * len(line)) :] for line in lines]
    for lower, upper in bands:
        widths = upper - lower
        known = np.isfinite(widths)
        if known.any():
            known &= widths <= WIDE * np.quantile(widths[known], USUAL)
        parts += [lower[known], upper[known]]
    sorted_dots = np.sort(_finite(dots))
    if sorted_dots.size:
        last = sorted_dots.size - 1
        parts.append(sorted_dots[[int(FEW * last), int(np.ceil((1 - FEW) * last))]])
    ruling = _finite(parts)
    every = _finite([*lines, *dots])
    if not ruling.size:
        ruling = every
    if not ruling.size:
        return 0.0, 1.0
    low, high = float(ruling.min()), float(ruling.max())
    reach = FAR * (high - low) or np.inf
    near = every[(every >= low - reach) & (every <= high + reach)]
    low, high = float(near.min(initial=low)), float(near.max(initial=high))
    margin = MARGIN * (high - low) or max(1e-9, 1e-3 * abs(high))
    return low - margin, high + margin


def _finite(columns: Sequence[np.ndarray]) -> np.ndarray:
    """All their numbers."""
    values = np.concatenate([*columns, np.zeros(0)])
    return values[np.isfinite(values)]
