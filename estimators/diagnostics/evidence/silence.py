"""When a sensor is silent: its period is learned as it speaks, and with it the threshold of its tests."""

from __future__ import annotations

import math

import numpy as np

from ...numerics.jit import part
from .bank import COUNT, DUE, FIRST, LAST, LONGEST, NEXT_DUE, SILENT, SILENT_SENSORS, THRESHOLD, sensor_part

LEARNT = 16.0
"""Readings of a sensor from which on its period is known; before, it is silent the later the fewer there are."""


@part
def note_time(own, now, every, tests, policy):
    """Note that a sensor has spoken: its period, its threshold, and when it will be silent."""
    count = own[COUNT]
    if count == 0.0:
        own[FIRST] = now
    else:
        own[LONGEST] = max(own[LONGEST], now - own[LAST])
    own[LAST] = now
    own[COUNT] = count + 1.0
    n = int(own[COUNT])
    period = (now - own[FIRST]) / count if count > 0.0 else 0.0
    if n <= 16 or n & (n - 1) == 0:
        # The rate of a sensor is known better and better; the threshold follows it in ever wider steps.
        own[THRESHOLD] = max(math.log(every / max(period, 1e-3) * tests), math.log(8.0 * tests))
    # A mean of few gaps is no period yet: of three readings that begin in haste the next is no silence.
    usual = policy.silent_periods * period
    patience = max(usual, min(usual * LEARNT / n, policy.stale_after))
    own[DUE] = now + max(patience, 2.0 * own[LONGEST]) if n > 2 else np.inf
    own[SILENT] = 0.0


@part
def listen(state, sensors, now):
    """Which sensors are silent; from when on the next will be."""
    due = np.inf
    for s in range(sensors):
        own = sensor_part(state, s)
        if now > own[DUE]:
            state[SILENT_SENSORS] += 1.0 - own[SILENT]
            own[SILENT] = 1.0
        elif own[DUE] < due:
            due = own[DUE]
    state[NEXT_DUE] = due
