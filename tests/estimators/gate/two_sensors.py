"""A level that two sensors read: what jumps is one of them, or the level."""

import numpy as np

from estimators.log import TICK, Events
from estimators.tuning import Tuning
from tests.models import level_model
from tests.support import SECOND, as_log, measured

MODEL = level_model({"a": 0.01, "b": 0.01}, 1e-4, max_step=1.0, linear=True)

TUNING = Tuning.of(MODEL).set("gate", 0.9999)

JUMP = 20.0
"""Seconds after which something jumps."""


def series(seed, *, a=0.0, b=0.0, noise_a=0.1, with_b=True, seconds=60.0, until=np.inf):
    """Sensor a at 10 Hz and b at 1 Hz, with ticks; from `JUMP` to `until` they read so much more."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.1)
    level = np.cumsum(rng.normal(0.0, 0.01 * np.sqrt(0.1), t.size))
    jumped = (t >= JUMP) & (t < until)
    noise = np.where(jumped, noise_a, 0.1)
    log = measured(MODEL, "a", t, level + noise * rng.standard_normal(t.size) + a * jumped)
    if with_b:
        log.add("b", t[5::10], (level + 0.1 * rng.standard_normal(t.size) + b * jumped)[5::10])
    ticks = [Events.one(int(at * SECOND), 0, TICK, 0, np.nan, 1) for at in np.arange(0.33, seconds, 3.0)]
    return as_log(Events.concat([log.events, *ticks], MODEL.width)).events
