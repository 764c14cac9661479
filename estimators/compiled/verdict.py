"""The verdict on a measurement by its NIS: one rule for every filter."""

from __future__ import annotations

import numpy as np

from ..numerics.jit import flags, floats, inlined
from ..track import FAILED, GATED, HELD_OUT, USED

LOG_2PI = float(np.log(2.0 * np.pi))


@inlined
def limit_of(context, sensor, m):
    """Return the NIS up to which a measurement with m finite rows passes the gate."""
    width = context.width + 1
    return floats(context.gate, context.n_sensors * width)[sensor * width + m]


@inlined
def verdict_of(context, sensor, m, nis, log_det, score):
    """Return the verdict on a measurement with m finite rows, and score NIS and log-likelihood.

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
        # An infinite innovation would leave an estimate of NaN.
        return USED if nis < np.inf else FAILED
    # A NIS of NaN is due to the model.
    return GATED if limit < nis else FAILED
