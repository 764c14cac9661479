"""What becomes of a reading, by its NIS: the same rule in every filter."""

from __future__ import annotations

import numpy as np

from ..numerics.jit import flags, floats, inlined
from ..track import FAILED, GATED, HELD_OUT, USED

LOG_2PI = float(np.log(2.0 * np.pi))


@inlined
def limit_of(context, sensor, m):
    """The NIS up to which a reading of m finite rows passes the gate."""
    width = context.width + 1
    return floats(context.gate, context.n_sensors * width)[sensor * width + m]


@inlined
def verdict_of(context, sensor, m, nis, log_det, score):
    """NIS, log-likelihood and verdict of a reading with m finite rows, from its NIS and log det S.

    log-likelihood = -½ (NIS + log det S + m log 2π)

    Source: Schweppe (1965), doi:10.1109/TIT.1965.1053737, for the likelihood as that of the innovations.
    """
    score[0] = nis
    score[1] = m
    score[2] = -0.5 * (nis + log_det + m * LOG_2PI)
    if flags(context.used, context.n_sensors)[sensor] == 0:
        return HELD_OUT
    limit = limit_of(context, sensor, m)
    if nis <= limit:
        # A reading that far off would leave an estimate that is no number.
        return USED if nis < np.inf else FAILED
    # Of a NIS that is no number the model is the reason.
    return GATED if limit < nis else FAILED
