"""Estimate the noise from the last innovations: each R, and all of Q scaled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimators.diagnostics.innovations import SensorNoise, sensor_noise
from estimators.tuning import Tuning

from ..interface import Running
from .sweep import MAX_SWEEP_EVENTS, Sweeps, Swept

CHANCE = 1e-3
"""Of innovations as correlated as they are, were the filter right, below which they are called so."""


@dataclass(frozen=True)
class NoiseEstimates:
    """Estimated R by key of the tuning, or the `reason` why there is none; and the sweep of all of Q.

    `doubts` has, by key, the reason not to use an estimate, also for "Q".
    """

    revision: int
    sensors: dict[str, SensorNoise]
    reason: str
    q: Swept
    doubts: dict[str, str]


def noise(engine: Running, sweeps: Sweeps) -> NoiseEstimates:
    """Estimate the noise from the last events of the running twin."""
    taken, q = engine.last_events(MAX_SWEEP_EVENTS, rows=True), sweeps.around("Q")
    if taken is None:
        return NoiseEstimates(q.revision, {}, "no readings yet", q, {})
    reason = _reason_against(engine, taken.tuning.options.get("adapt", 0.0))
    rows = {} if reason else sensor_noise(taken.track, taken.events, taken.tuning)
    found = _by_key(engine, taken.tuning, rows)
    if any(_doubtful(noise) for noise in found.values()):
        # A wrong R alone leaves correlated innovations too; with the right one they are white.
        matched = sweeps.matched()
        if matched is not None:
            found = _by_key(engine, taken.tuning, matched.rows)
    return NoiseEstimates(taken.revision, found, reason, q, doubts(found, q.level))


def _by_key(engine: Running, tuning: Tuning, rows: Mapping[str, SensorNoise]) -> dict[str, SensorNoise]:
    """Return the estimates by the tuning's keys: of one row, or of all rows that share an entry."""
    found = {}
    for item in tuning.items():
        if item.key.startswith("R."):
            known = [rows[name] for name in _rows_of(engine, item.key[2:]) if name in rows]
            if known:
                found[item.key] = _mean(known)
    return found


def _doubtful(noise: SensorNoise) -> bool:
    return noise.chance < CHANCE


def doubts(found: Mapping[str, SensorNoise], level: float | None) -> dict[str, str]:
    """Return, by key, why an estimate should not be used: the innovations are correlated, so their size misleads.

    Matching R to their size treats a coloured error as white noise: the bands become too narrow, and the estimate
    follows the error. Matching Q is right only if it would remove the correlation too.

    Args:
        found: Estimated R by key.
        level: Factor of all of Q at which the NIS is consistent; None if not known.
    """
    correlated = {key: noise for key, noise in found.items() if _doubtful(noise)}
    said = {
        key: f"the innovations are correlated ({noise.correlation:+.2f} with the next, where chance allows "
        f"±{2.0 / np.sqrt(noise.n):.2f}): a state is missing, Q is wrong, or the sensor's error lasts; their size does "
        f"not determine R"
        for key, noise in correlated.items()
    }
    signs = {np.sign(noise.correlation) for noise in correlated.values()}
    if level is not None and signs and np.sign(np.log(level)) not in signs:
        more = "larger" if 1.0 in signs else "smaller"
        said["Q"] = f"the innovations are correlated, for which Q would have to be {more}: look for a missing state"
    return said


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
    variances, stds, counts, _, chances = (np.array(column, float) for column in zip(*known, strict=True))
    std, worst = float(np.sqrt(np.sum(stds**2)) / len(known)), int(np.argmin(chances))
    # The least of many chances is small by chance.
    chance = min(1.0, len(known) * float(chances[worst]))
    return SensorNoise(float(variances.mean()), std, int(counts.sum()), known[worst].correlation, chance)
