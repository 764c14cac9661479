"""What the data say of Q and R: the noise that the last innovations would have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.diagnostics.innovation_size import SensorNoise, sensor_noise

from ..engine.interface import Running
from .sweep import MOST, Sweeps, Swept
from .window import window


@dataclass(frozen=True)
class Noise:
    """By key of the tuning what the innovations say of each R, or the `reason` why not; and all of Q scaled, swept."""

    revision: int
    sensors: dict[str, SensorNoise]
    reason: str
    q: Swept


def noise(engine: Running, sweeps: Sweeps) -> Noise:
    """What the last events of the running twin say."""
    taken, q = window(engine, MOST), sweeps.around("Q")
    if taken is None:
        return Noise(q.revision, {}, "no readings yet", q)
    reason = _reason_against(engine, taken.tuning.options.get("adapt", 0.0))
    rows = {} if reason else sensor_noise(taken.track, taken.pull.events, taken.tuning)
    found = {}
    for item in taken.tuning.items():
        if item.key.startswith("R."):
            names = _rows_of(engine, item.key[2:])
            known = [rows[name] for name in names if name in rows]
            if known:
                found[item.key] = _mean(known)
    return Noise(taken.pull.revision, found, reason, q)


def _reason_against(engine: Running, adapt: float) -> str:
    if engine.twin.plan.brings_variances:
        return "the readings bring their own variances"
    return "the filter adapts its noise itself" if adapt else ""


def _rows_of(engine: Running, name: str) -> tuple[str, ...]:
    """A row, or all rows of a sensor that share an entry."""
    model = engine.model
    if name in model.row_names:
        return (name,)
    k = model.sensor_names.index(name)
    return tuple(model.row_names[model.row_start[k] : model.row_start[k] + len(model.sensors[k].rows)])


def _mean(known: list[SensorNoise]) -> SensorNoise:
    variances, stds, counts = (np.array(column, float) for column in zip(*known, strict=True))
    return SensorNoise(float(variances.mean()), float(np.sqrt(np.sum(stds**2)) / len(known)), int(counts.sum()))
