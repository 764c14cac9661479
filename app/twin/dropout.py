"""After how long without a reading a twin is degraded: as the YAML says, or as long as its model remembers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from config.schema import TwinSection
from estimators.diagnostics.time_constants import MOST, jacobian, time_constants
from estimators.errors import ModelError
from estimators.model.state_space import StateSpaceModel

LEAST = 3.0
"""Seconds: below this a reading that is a little late would be a dropout."""

PERIODS = 3.0
"""Periods of the slowest sensor that must be missed, where they are known."""


class DegradedAfter(NamedTuple):
    """Seconds without a reading after which the twin is degraded, and where they come from."""

    seconds: float
    reason: str


def degraded_after(config: TwinSection, model: StateSpaceModel) -> DegradedAfter:
    """What the YAML gives; else the slowest time constant of the model at its prior, within what makes sense."""
    section = config.time
    if section.degraded_after is not None:
        return DegradedAfter(section.degraded_after, "time.degraded_after")
    slowest = _slowest(model)
    period = _slowest_sensor(config)
    least = LEAST if period is None else max(LEAST, PERIODS * period)
    if slowest is None:
        reason = "the model has no time constant (nothing in it decays), so the least that makes sense"
        seconds = least
    else:
        reason = f"the slowest time constant of the model, {slowest:.4g} s"
        seconds = max(slowest, least)
        if seconds > slowest:
            reason += f", is below {least:g} s" + ("" if least == LEAST else ", three periods of the slowest sensor")
    if seconds > section.stale_after:
        seconds, reason = section.stale_after, f"{reason}, and no later than time.stale_after"
    return DegradedAfter(float(seconds), reason)


def _slowest(model: StateSpaceModel) -> float | None:
    if model.black_box or model.nx > MOST:
        return None
    u = np.array([item.default for item in model.inputs], float)
    p = np.array([item.value for item in model.parameters], float)
    dt = min(model.max_step, 1.0)
    try:
        constants = time_constants(jacobian(model, model.prior_mean.copy(), u, p, dt), dt)
    except ModelError:
        return None
    return float(constants[0]) if constants.size else None


def _slowest_sensor(config: TwinSection) -> float | None:
    """Seconds between two readings of the slowest sensor, where the source simulates it."""
    asset = getattr(config.source, "asset", None) or config.source
    step, sensors = getattr(asset, "step", None), getattr(asset, "sensors", {})
    if step is None:
        return None
    return float(step * max([getattr(item, "every", 1) for item in sensors.values()], default=1))
