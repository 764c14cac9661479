"""How many steps of a model cross a time."""

from __future__ import annotations

import math

from .jit import jit

SLACK = 1e-3
"""Share of a step by which a step may be longer than `max_step`.

0.3 s in steps of 0.1 s are three, though 0.3 / 0.1 is a little more than 3 in floating point; and so are three periods
of 1/30 s, though timestamps are whole nanoseconds. `max_step` bounds how far a crude integration goes, which a
thousandth does not change.
"""


@jit
def steps_of(dt: float, max_step: float) -> int:
    """The fewest equal steps that cross `dt` seconds with none longer than `max_step`, within `SLACK` of a step."""
    return max(1, int(math.ceil(dt / max_step - SLACK)))
