"""What the tests say of a row, a sensor or the twin: the bits of `Track.alarms` and of `Track.flags`."""

from __future__ import annotations

CAUSES = (
    "narrow", "wide", "shifted up", "shifted down", "correlated", "alternating", "spiky", "refused", "stuck",
    "disagreeing", "agreeing", "missed",
)  # fmt: skip
"""What a test says of a row: its bands are too narrow or too wide; it is shifted, up or down;
its innovations are correlated, or change sign; spikes; the gate refuses it; it repeats itself; the rows of one sensor
contradict each other, or are closer than their noise; the truth that was told is outside the band. Bits of
`Track.alarms`, in this order."""

(
    NARROW, WIDE, SHIFTED_UP, SHIFTED_DOWN, CORRELATED, ALTERNATING, SPIKY, REFUSED, STUCK, DISAGREEING, AGREEING,
    MISSED,
) = (1 << k for k in range(len(CAUSES)))  # fmt: skip

LOST = REFUSED | STUCK
"""Causes for which a sensor tells nothing more."""

IMPOVERISHED, OUTSIDE, TRUTH_MISSED = 1 << 59, 1 << 60, 1 << 61
"""Bits of `Track.flags` beside those of the sensors that are silent: a few particles carry the estimate; outside the
range in which the model was fitted; the truth that was told is missed."""

SENSORS = 58
"""Sensors that have a bit of their own in `Track.flags`; the others share the last."""
