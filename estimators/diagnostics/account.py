"""What a filter says of itself: particles that count, where readings lie among members, spread against innovation."""

from __future__ import annotations

import numpy as np

from ..track import GATED, USED, Track
from .health import FAR


def spread_ratio(track: Track, window: int) -> float:
    """Predicted over actual variance of the innovations, over the last `window` readings that were used or gated.

    1 / mean(ν² / S) over their rows: below 1 the spread is too small, above 1 too large. NaN where there is none.
    """
    verdict = track.verdict[-FAR * window :]
    rows = np.flatnonzero((verdict == USED) | (verdict == GATED))[-window:] + len(track) - verdict.size
    e = track.innovation[rows] / track.innovation_std[rows]
    e = e[np.isfinite(e)]
    square = float(np.mean(e * e)) if e.size else np.nan
    return 1.0 / square if square > 0.0 else np.nan
