"""What was refused at the edge, in words: sensor, value, rule, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from estimators.log import Log
from estimators.model.limits import Limits, Pair
from estimators.model.state_space import StateSpaceModel
from estimators.track import REASONS, Track


def refusals(model: StateSpaceModel, log: Log, track: Track, first: int) -> Iterator[tuple[str, str]]:
    """Key and text for each sensor and reason of which rows from `first` on were refused: the last of them."""
    found = np.argwhere(track.screened[first:])
    last = {}
    for i, k in found.tolist():
        bits, sensor = int(track.screened[first + i, k]), int(log.channel[first + i])
        for reason in range(len(REASONS)):
            if bits & (1 << reason):
                last[sensor, reason] = (first + i, k)
    for (sensor, reason), (i, k) in last.items():
        yield f"{REASONS[reason]} {model.sensors[sensor].name}", _text(model, sensor, k, reason, float(log.value[i, k]))


def _text(model: StateSpaceModel, sensor: int, k: int, reason: int, value: float) -> str:
    item = model.sensors[sensor]
    limits, unit = item.limits or Limits(), item.rows[k].unit
    name = model.row_names[model.row_start[sensor] + k]

    def ends(pairs: tuple[Pair, ...]) -> str:
        low, high = pairs[k % len(pairs)]
        return f"{low:g} to {high:g} {unit}"

    what = f"{name}: {value:.6g} {unit}"
    match REASONS[reason]:
        case "range":
            return f"{what} is outside {ends(limits.range)}; not used: look at the sensor, or widen its range"
        case "saturated":
            inside = ends(limits.saturation)
            return f"{what} is where its converter clips, {inside}; not used: the quantity may lie anywhere beyond"
        case "rate":
            most = f"{limits.rate[k % len(limits.rate)]:g} {unit}/s"
            return f"{what} is further from the last good reading than {most} allows; not used until it comes back"
        case "stuck":
            return f"{what} has been repeated for too long; not used until it changes: look at the sensor"
        case _:
            return f"{what} came again; it counts once: look for what repeats readings on their way"
