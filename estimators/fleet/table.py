"""State of all assets of a fleet, one row each, and the cause of each alarm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..diagnostics.detector_state import JOINT_MASK, MASK, ROW, SENSOR, TWIN
from ..diagnostics.detectors import DETECTORS, IMPOSSIBLE, OUTSIDE, SENSOR_MASK, detector_of
from ..model.state_space import StateSpaceModel
from ..track import DEGRADED, DIVERGED, HEALTH_NAMES, STALE


class FleetTable(NamedTuple):
    """One row per asset, in the order of `Fleet.assets`.

    seconds (N,): time of the last event, NaN before the first. since (N,): time of the event that changed health
    last, s. mean, std (N, nx): the last estimate, in the units of the states. health (N,): index into
    `HEALTH_NAMES`. cause (N,): name of the most severe detector in alarm, or "". age (N,): seconds since the last
    measurement, at the last event. verdict (N,): on the last event. nis_mean, nis_low, nis_high (N,): mean NIS over the
    last measurements and its 95 % bounds. events, stale (N,): events folded, and dropped as too late.
    """

    assets: Sequence[object]
    seconds: np.ndarray
    since: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    health: np.ndarray
    cause: np.ndarray
    age: np.ndarray
    verdict: np.ndarray
    nis_mean: np.ndarray
    nis_low: np.ndarray
    nis_high: np.ndarray
    events: np.ndarray
    stale: np.ndarray

    def worst(self, count: int = 10) -> np.ndarray:
        """Return the indices of the assets of worst health, the worst first, at most `count`."""
        order: np.ndarray = np.argsort(-self.health, kind="stable")
        return order[:count]


def causes_of(model: StateSpaceModel, evidence: np.ndarray, flags: np.ndarray, health: np.ndarray) -> np.ndarray:
    """Return the name of the most severe detector in alarm of each asset, or "", (assets,).

    Args:
        model: Model of the assets.
        evidence: State of the detectors, (assets, numbers).
        flags: Bits of other conditions, (assets,).
        health: Index into `HEALTH_NAMES`, (assets,).
    """
    sensors, rows = len(model.sensors), len(model.row_names)
    masks = np.zeros(len(evidence), np.int64)
    for s in range(sensors):
        masks |= evidence[:, TWIN + s * SENSOR + JOINT_MASK].astype(np.int64)
    for k in range(rows):
        masks |= evidence[:, TWIN + sensors * SENSOR + k * ROW + MASK].astype(np.int64)
    kinds, which = np.unique(np.stack([masks, flags, health], axis=1), axis=0, return_inverse=True)
    names: np.ndarray = np.array([_cause(*kind) for kind in kinds.tolist()])
    return names[which.ravel()]


def _cause(mask: int, flags: int, health: int) -> str:
    """Return the name of the most severe detector in alarm, or ""."""
    causes = [detector.name for detector in DETECTORS if detector.bits & mask]
    causes += ["silent"] if flags & SENSOR_MASK else []
    causes += ["outside"] if flags & OUTSIDE else []
    causes += ["impossible"] if flags & IMPOSSIBLE else []
    causes += [HEALTH_NAMES[health]] if health in (STALE, DIVERGED) else []
    if health == DEGRADED and not any(detector_of(name).grade == HEALTH_NAMES[DEGRADED] for name in causes):
        causes.append("silent")  # for `degraded_after`, of sensors that have no period, or need not report
    return min(causes, key=lambda name: detector_of(name).severity, default="")
